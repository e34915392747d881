"""The mini-golf course: positions and sizes of its bodies, and the unknown parameters."""

import math
from dataclasses import dataclass

__all__ = ["MEASURED_OBSTACLES", "OBSTACLES", "RAILS", "Box", "StrikeParameters"]


@dataclass(frozen=True)
class Box:
    """A box that stands on the ground.

    Attributes:
        centre: Centre in m.
        size: Edge lengths in m.
        angle: Turn about the vertical axis in rad.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    angle: float = 0.0

    def moved(self, dx: float, dy: float, turn: float) -> "Box":
        """Returns the box shifted by dx and dy in m and turned by ``turn`` in rad."""
        x, y, z = self.centre
        return Box((x + dx, y + dy, z), self.size, self.angle + turn)


RAILS = (
    Box((0.85, 1.70, 0.02), (1.1, 0.04, 0.04)),
    Box((0.85, 0.90, 0.02), (1.1, 0.04, 0.04)),
    Box((1.42, 1.30, 0.02), (0.84, 0.04, 0.04), math.radians(-90.0)),
)
"""Outer, inner and end rail."""

OBSTACLES = (
    Box((0.90, 1.45, 0.015), (0.58, 0.03, 0.03), math.radians(-5.0)),
    Box((0.60, 1.20, 0.015), (0.58, 0.03, 0.03), math.radians(25.0)),
)
"""The left obstacle (1) and the right one (2)."""

MEASURED_OBSTACLES = ((0.852088, 1.48181, -7.7), (0.576446, 1.21897, 29.3))
"""Both obstacles of the rig, by motion capture: x and y of the centre in m, angle in degrees."""

HOLE = (1.18977, 1.37017)
HOLE_DEPTH = 0.002
HOLE_RISE = 1e-4
"""Height of the disc's top above the ground in m. The ball stops once its point of contact is on
the disc. A disc 1 mm high would stop it 0.5 cm earlier, at the rim. A disc 10 µm high lets fast
balls pass, because the ground still supports them."""

HOLE_FRICTION = 10.0
"""Friction and, in m, rolling friction of the disc that represents the hole."""

CLUB_HEAD_SIZE = (0.017, 0.07, 0.01)
CLUB_MASS = 0.9
"""The head's mass in kg, large enough that a ball of a few grams does not change its path."""

DEFAULT_FRICTION = 0.8
"""Friction of rails, obstacles and club head."""


@dataclass(frozen=True)
class StrikeParameters:
    """Numbers that describe one strike; see :class:`~npdr_ppl.models.mini_golf.MiniGolf`.

    Attributes:
        ball_radius: In m.
        ball_mass: In kg.
        club_restitution: Rebound of ball and club head, relative.
        obstacle_restitution: Rebound of ball and obstacles or rails, relative.
        ball_rolling_friction: In m.
        ball_friction: Dimensionless; it multiplies the other body's.
        ball_inertia_factor: Moment of inertia over m r²: 2/5 for a solid ball.
        ground_friction: Dimensionless.
        hole_radius: In m.
        obstacle_shifts: (dx in m, dy in m, turn in rad) of the left and the right obstacle.
    """

    ball_radius: float
    ball_mass: float
    club_restitution: float
    obstacle_restitution: float
    ball_rolling_friction: float
    ball_friction: float
    ball_inertia_factor: float
    ground_friction: float
    hole_radius: float
    obstacle_shifts: tuple[tuple[float, float, float], tuple[float, float, float]]
