"""Dry friction: bounds that hold a joint at rest, and bristles that remember."""

from collections.abc import Callable, Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["BRISTLE_LAWS", "Bristles", "DRY_LAWS", "DryLaw", "bouc_wen", "lugre"]

Values = Mapping[str, float]

DryLaw = Callable[[Values, Array, Array, Array, Array], Array]
"""Greatest dry friction: ``law(parameters, direction, q, v, drive)``, arrays ``(R,)``.

The direction is that of the motion, or at rest that in which the joint would break away.
"""


def coulomb_friction(p: Values, direction: Array, q: Array, v: Array, drive: Array) -> Array:
    """The same everywhere."""
    return np.full_like(q, p["magnitude"])


def asymmetric_coulomb_friction(
    p: Values, direction: Array, q: Array, v: Array, drive: Array
) -> Array:
    """One value forwards, another backwards."""
    return np.where(direction > 0.0, p["forward"], p["backward"])


def stribeck_friction(p: Values, direction: Array, q: Array, v: Array, drive: Array) -> Array:
    """The excess of static over sliding friction."""
    return p["excess"] * np.exp(-np.abs(v) / p["speed"])


def load_dependent_friction(
    p: Values, direction: Array, q: Array, v: Array, drive: Array
) -> Array:
    """In proportion to what the drive exerts."""
    return p["coefficient"] * np.abs(drive)


def position_dependent_friction(
    p: Values, direction: Array, q: Array, v: Array, drive: Array
) -> Array:
    """Waxes and wanes along the path, between nothing and twice the mean; in no catalogue."""
    return p["magnitude"] * (1.0 + np.sin(p["wave_number"] * q))


DRY_LAWS: dict[str, DryLaw] = {
    law.__name__: law
    for law in (
        coulomb_friction,
        asymmetric_coulomb_friction,
        stribeck_friction,
        load_dependent_friction,
        position_dependent_friction,
    )
}
"""Laws by the effect's id."""


class Bristles:
    """A force −F (x + τ ẋ) of bristles whose bend x follows ẋ = (v − |v| (γ + β sign(v x)) x)/z.

    γ + β = 1, so that x stays within ±1. With β = 0 the LuGre model of constant friction; with
    β > 0 a hysteresis after Bouc and Wen, which unloads along another path than it loads.

    The bend is advanced exactly for a constant velocity, between the integrator's steps.

    Args:
        magnitude: Friction F in steady sliding.
        deflection: Bristle deflection z.
        relaxation: Bristle damping over stiffness τ, in s.
        asymmetry: β.
        num_rollouts: R.
    """

    def __init__(
        self,
        magnitude: float,
        deflection: float,
        relaxation: float,
        asymmetry: float,
        num_rollouts: int,
    ) -> None:
        self.magnitude, self.deflection = magnitude, deflection
        self.relaxation, self.asymmetry = relaxation, asymmetry
        self.bend = np.zeros(num_rollouts)

    def force(self, v: Array) -> Array:
        """Returns the force at a velocity, the bend as it is."""
        rate = (v - np.abs(v) * self._drag(v) * self.bend) / self.deflection
        return -self.magnitude * (self.bend + self.relaxation * rate)

    def advance(self, v: Array, step: float) -> None:
        """Moves the bristles through a step of so many seconds."""
        drag = self._drag(v)
        travelled = v * step / self.deflection
        rigid = drag < 1e-9  # unloads like a spring
        safe = np.where(rigid, 1.0, drag)
        target = np.sign(v) / safe
        sliding = target + (self.bend - target) * np.exp(-np.abs(travelled) * safe)
        self.bend = np.clip(np.where(rigid, self.bend + travelled, sliding), -1.0, 1.0)

    def _drag(self, v: Array) -> Array:
        """Returns γ + β sign(v x)."""
        return 1.0 - self.asymmetry + self.asymmetry * np.sign(v * self.bend)


def lugre(p: Values, num_rollouts: int) -> Bristles:
    """Returns the bristles of presliding friction."""
    return Bristles(p["magnitude"], p["deflection"], p["relaxation"], 0.0, num_rollouts)


def bouc_wen(p: Values, num_rollouts: int) -> Bristles:
    """Returns a hysteresis that spans a good part of the range; in no catalogue."""
    return Bristles(p["magnitude"], p["deflection"], 0.0, p["asymmetry"], num_rollouts)


BRISTLE_LAWS: dict[str, Callable[[Values, int], Bristles]] = {
    "presliding_friction": lugre,
    "bouc_wen_hysteresis": bouc_wen,
}
"""Laws by the effect's id."""
