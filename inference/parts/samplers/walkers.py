"""Markov chain Monte Carlo with an ensemble: steps of a walker are made from other walkers.

One sweep moves each half of the walkers in turn, with the other half fixed (Foreman-Mackey et al.
2013). There are three moves: a small difference of two walkers, one of random length
(differential evolution; ter Braak 2006), and the stretch of Goodman & Weare (2010). They adapt to
the scales and correlations of the density and have no step size to tune. A whole half moves in one
batch.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["LogDensity", "ensemble_draws"]

STRETCH = 2.0
"""Greatest factor of a stretch; its inverse is the smallest (Goodman & Weare 2010)."""

DIFFERENCES = (0.2, 1.2)
"""Least and greatest factor of a difference, in units of 2.38/√(2d), which is optimal for normal
densities (ter Braak 2006). Smaller ones suit bent densities."""

SMALL_DIFFERENCE = 0.3
"""Factor of the small difference."""

SURROGATE_MOVES = 32
"""Moves under a surrogate for each evaluation of the density."""

PLAIN_EVERY = 4
"""Every fourth sweep, from the first on, uses no surrogate. It reaches points that the surrogate
rules out."""


LogDensity = Callable[[Tensor], Tensor]
"""Maps points ``(n, d)`` to log densities up to a constant, ``(n,)``; −∞ outside the support."""


def ensemble_draws(
    log_density: LogDensity,
    walkers: Tensor,
    *,
    sweeps: int,
    interval: int,
    generator: torch.Generator,
    surrogate: LogDensity | None = None,
) -> Tensor:
    """Moves walkers, and returns their positions from the second half of the sweeps.

    With a surrogate, in three of four sweeps a walker first makes :data:`SURROGATE_MOVES` moves
    under the surrogate's density. Where that leads is then accepted or rejected as a whole, so
    that the density is kept exactly (surrogate transitions; Liu 2001, section 9.4.3).

    Args:
        log_density: The density.
        walkers: First positions, ``(W, d)`` in float64, distributed roughly like the density.
        sweeps: Number of sweeps; each costs W evaluations of the density.
        interval: Sweeps between positions that are returned, counted back from the last one.
        generator: Source of all randomness.
        surrogate: A density close to it that costs little to evaluate.

    Returns:
        The positions, ``(k W, d)``.
    """
    walkers, log_values = walkers.clone(), log_density(walkers)
    kept = []
    for sweep in range(1, sweeps + 1):
        order = torch.randperm(len(walkers), generator=generator)
        for moving, fixed in ((order[::2], order[1::2]), (order[1::2], order[::2])):
            if surrogate is None or sweep % PLAIN_EVERY == 1:
                proposed, correction = _proposed(walkers[moving], walkers[fixed], generator)
            else:
                proposed, correction = _led(walkers[moving], walkers[fixed], surrogate, generator)
            values = log_density(proposed)
            is_accepted = _accepted(values - log_values[moving] + correction, generator)
            walkers[moving[is_accepted]] = proposed[is_accepted]
            log_values[moving[is_accepted]] = values[is_accepted]
        if 2 * sweep > sweeps and (sweeps - sweep) % interval == 0:
            kept.append(walkers.clone())
    return torch.cat(kept)


def _led(
    moving: Tensor, fixed: Tensor, surrogate: LogDensity, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Returns where walkers come to under a surrogate, and the correction of that proposal."""
    place, first = moving.clone(), surrogate(moving)
    present = first.clone()
    for _ in range(SURROGATE_MOVES):
        proposed, correction = _proposed(place, fixed, generator)
        values = surrogate(proposed)
        is_accepted = _accepted(values - present + correction, generator)
        place[is_accepted], present[is_accepted] = proposed[is_accepted], values[is_accepted]
    return place, first - present


def _proposed(moving: Tensor, fixed: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Returns one of three moves of each walker, and the log of its correction for volume.

    Each move is drawn independently, so that a sequence of moves is reversible.
    """
    size, d = moving.shape
    first, second = (
        fixed[torch.randint(len(fixed), (size,), generator=generator)] for _ in range(2)
    )
    uniform = torch.rand(size, 1, generator=generator, dtype=torch.float64)
    kind = torch.randint(3, (size, 1), generator=generator)
    least, greatest = DIFFERENCES
    length = (least + (greatest - least) * uniform) * 2.38 / math.sqrt(2.0 * d)
    length = torch.where(kind == 0, SMALL_DIFFERENCE, length)
    stretch = ((STRETCH - 1.0) * uniform + 1.0).square() / STRETCH
    proposed = torch.where(
        kind == 2, first + stretch * (moving - first), moving + length * (first - second)
    )
    correction = torch.where(kind == 2, (d - 1) * stretch.log(), 0.0)
    return proposed, correction[:, 0]


def _accepted(log_ratio: Tensor, generator: torch.Generator) -> Tensor:
    """Returns which moves are accepted (Metropolis & Hastings); NaN is not."""
    return torch.rand(len(log_ratio), generator=generator, dtype=torch.float64).log() < log_ratio
