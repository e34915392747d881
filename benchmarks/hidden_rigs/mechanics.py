"""What the equations of motion of a rig have to say, and their solution for the accelerations."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Flags", "Mechanics", "Surroundings", "accelerations"]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Surroundings:
    """What surrounds a rig.

    Attributes:
        roll: Turn of gravity about the base's x axis, in rad.
        pitch: Turn of gravity about the base's y axis, after that, in rad.
        payload: Extra mass where the rig carries one, in kg.
    """

    roll: float = 0.0
    pitch: float = 0.0
    payload: float = 0.0

    def gravity(self, magnitude: float) -> tuple[float, float, float]:
        """Returns gravity along x, y and z (up) of the base, in m/s²."""
        down = -magnitude * math.cos(self.roll)
        return (
            down * math.sin(self.pitch),
            magnitude * math.sin(self.roll),
            down * math.cos(self.pitch),
        )


class Mechanics(ABC):
    """M(q) q̈ = f(q, q̇) + τ of one or two joints; every quantity is ``(R,)`` for R rollouts.

    Args:
        parameters: Domain parameters, in the units of the model under test.
        surroundings: Gravity's direction and the payload.
    """

    num_joints: int

    def __init__(self, parameters: Mapping[str, float], surroundings: Surroundings) -> None:
        self.parameters = parameters
        self.surroundings = surroundings

    @abstractmethod
    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns (M₁₁,) of one joint, or (M₁₁, M₂₂, M₁₂) of two; q is ``(joints, R)``."""

    @abstractmethod
    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns f: gravity, velocity products, damping; not what the drives exert."""

    @abstractmethod
    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns τ, what the drives exert at each joint under the commands."""

    def drive_inertia(self, joint: int) -> float:
        """Returns the inertia that a force at a joint sees in the pose zero, in kg m² or kg."""
        entries = self.inertia(np.zeros((self.num_joints, 1)))
        if len(entries) == 1:
            return _number(entries[0])
        own, other, cross = _number(entries[joint]), _number(entries[1 - joint]), entries[2]
        return own - _number(cross) ** 2 / other


def accelerations(
    inertia: Sequence[Array | float], forces: Sequence[Array], held: Sequence[Flags | None]
) -> list[Array]:
    """Solves M a = f where held joints do not accelerate.

    Args:
        inertia: See :meth:`Mechanics.inertia`.
        forces: Total force at each joint.
        held: Where each joint is held, ``None`` for nowhere.
    """
    if len(inertia) == 1:
        result = [forces[0] / inertia[0]]
    else:
        first, second, cross = inertia
        for flags in held:
            if flags is not None:
                # A joint that is held takes no part in the other's motion.
                cross = np.where(flags, 0.0, cross)
        determinant = first * second - cross * cross
        result = [
            (second * forces[0] - cross * forces[1]) / determinant,
            (first * forces[1] - cross * forces[0]) / determinant,
        ]
    return [
        a if flags is None else np.where(flags, 0.0, a)
        for a, flags in zip(result, held, strict=True)
    ]


def _number(value: Array | float) -> float:
    return float(np.ravel(value)[0])
