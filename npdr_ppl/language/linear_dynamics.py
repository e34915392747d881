"""Equations of motion that are linear in base parameters, for linear regression.

The inverse dynamics of a rigid mechanism are linear in *base parameters* β, combinations of its
physical parameters (masses, lengths, dampings):

    Y(q, q̇, q̈, u) β = t(q, q̇, q̈, u)

with one row per joint. A simulator whose equations have this form declares them as an
:class:`InverseDynamics`, and regression finds β in closed form, without simulating.

References: C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of
manipulator loads and links, 1986; M. Gautier, W. Khalil, Direct calculation of minimum set of
inertial parameters of serial robots, 1990.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["BaseParameter", "InverseDynamics", "Motion"]


@dataclass(frozen=True)
class BaseParameter:
    """A combination of physical parameters that the equations of motion are linear in.

    Attributes:
        name: Name for tables, e.g. ``"hinge_inertia"``.
        unit: Unit of its term's factor, e.g. ``"kg m²"``.
        description: The combination, in symbols.
    """

    name: str
    unit: str
    description: str = ""


@dataclass(frozen=True)
class Motion:
    """Motion of a mechanism at N instants; each entry of a tuple has the shape ``(N,)``.

    Attributes:
        positions: Generalised positions, one tensor per joint.
        velocities: Their first derivatives.
        accelerations: Their second derivatives.
        actions: Commands at each instant, one tensor per action channel.
    """

    positions: tuple[Tensor, ...]
    velocities: tuple[Tensor, ...]
    accelerations: tuple[Tensor, ...]
    actions: tuple[Tensor, ...]


class InverseDynamics(ABC):
    """Y(q, q̇, q̈, u) β = t, and the maps between β and the physical parameters.

    Neither Y nor t may depend on a parameter. A parameter that scales or shifts them, such as a
    motor's gain, must be a part of β.

    Attributes:
        base: The base parameters β, in the order of Y's columns.
        determined: Physical parameters that follow from β if all others are given. The others
            (a motor's constants, gravity) may appear in β, but measurements of the motion cannot
            determine them.
        positive: Physical parameters that must be greater than zero.
        non_negative: Physical parameters that must not be less than zero.
    """

    base: tuple[BaseParameter, ...]
    determined: tuple[str, ...]
    positive: tuple[str, ...] = ()
    non_negative: tuple[str, ...] = ()

    @abstractmethod
    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y, ``(N, joints, k)``."""

    @abstractmethod
    def targets(self, motion: Motion) -> Tensor:
        """Returns t, ``(N, joints)``."""

    @abstractmethod
    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Maps physical parameters, all of shape B, to base parameters, ``B + (k,)``."""

    @abstractmethod
    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Maps base parameters to the determined ones; the inverse of :meth:`to_base`.

        Args:
            base: Base parameters, ``B + (k,)``, of any value.
            given: Physical parameters of shape B; the determined ones are ignored.

        Returns:
            The determined parameters, which may be implausible: negative, infinite or NaN.
        """

    def force_scale(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the change of a row per unit of generalised force at its joint, shape B.

        It is one if t is a force or torque, and 1/(gain) if t is a command.
        """
        return torch.ones_like(next(iter(parameters.values())))

    def is_physical(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns a mask of shape B: which parameter sets are physically possible."""
        possible = torch.stack([parameters[name].isfinite() for name in self.determined]).all(0)
        for name in self.positive:
            possible = possible & (parameters[name] > 0.0)
        for name in self.non_negative:
            possible = possible & (parameters[name] >= 0.0)
        return possible
