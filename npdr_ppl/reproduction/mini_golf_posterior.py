"""Results from a mini-golf posterior: the facts of Figure 4, and the obstacles' angles."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.models.mini_golf.course import MEASURED_OBSTACLES, OBSTACLES
from npdr_ppl.posterior.posterior import PosteriorBase

__all__ = ["figure4_facts", "obstacle_angles"]

NUM_DRAWS = 5_000
SIDES = ("left", "right")


def figure4_facts(posterior: PosteriorBase, *, seed: int = 0) -> dict[str, Any]:
    """Returns the facts that Figure 4 of Muratore et al. (2021) shows, as numbers.

    Args:
        posterior: A posterior over the ten parameters.
        seed: Seed of the draws.

    Returns:
        ``mass_spread``: standard deviation of the ball's mass relative to the prior's, 1 if the
        strike contains no information about it; ``radius_restitution`` and ``<side>_x_y``:
        correlations; ``<side>_turned_round``: share of the draws in which an obstacle is rotated
        by more than 90°. A box rotated by 180° is the same box, so there are two modes.
    """
    draws = {
        name: v.double().numpy() for name, v in posterior.sample(NUM_DRAWS, seed=seed).items()
    }
    everywhere = posterior.prior.to_parameters(posterior.prior.sample(NUM_DRAWS))
    facts: dict[str, Any] = {
        "mass_spread": float(draws["ball_mass"].std() / everywhere["ball_mass"].std()),
        "radius_restitution": _correlation(draws["ball_radius"], draws["ball_restitution"]),
    }
    for side in SIDES:
        facts[f"{side}_x_y"] = _correlation(draws[f"{side}_shift_x"], draws[f"{side}_shift_y"])
        facts[f"{side}_turned_round"] = float(np.mean(np.abs(draws[f"{side}_turn"]) > math.pi / 2))
    return facts


def obstacle_angles(parameters: dict[str, Tensor]) -> dict[str, dict[str, float]]:
    """Returns both obstacles' angles and those of motion capture, in degrees.

    Args:
        parameters: Values by site, e.g. the most likely ones, or several of each, ``(n,)``.

    Returns:
        ``angle``, ``measured`` and ``error`` by side. Several values are averaged; a box is the
        same after half a turn, so this is the mean direction of axes (Mardia & Jupp 2000, §9.2).
    """
    result = {}
    for side, box, measured in zip(SIDES, OBSTACLES, MEASURED_OBSTACLES, strict=True):
        doubled = 2.0 * (box.angle + parameters[f"{side}_turn"].double())
        mean = 0.5 * math.atan2(float(doubled.sin().mean()), float(doubled.cos().mean()))
        angle, seen = _half_turn(math.degrees(mean)), measured[2]
        result[side] = {"angle": angle, "measured": seen, "error": _half_turn(angle - seen)}
    return result


def _half_turn(degrees: float) -> float:
    """Returns an angle modulo 180 degrees, between −90 and 90."""
    return (degrees + 90.0) % 180.0 - 90.0


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a, b)[0, 1])
