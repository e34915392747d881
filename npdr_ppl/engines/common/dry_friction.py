"""Dry friction as a set-valued law, solved within a step instead of smoothed.

Over a step of h seconds the accelerations are affine in the generalised forces, a = a₀ + W f with
the inverse inertia W. By Coulomb's law, f_i is the force within ±F_i that brings the joint to rest
by the end of the step, or ±F_i against the motion if no such force does:

    f minimises  ½ h fᵀ W f + (v + h a₀)ᵀ f   subject to |f_i| ≤ F_i.

At rest this is stiction; in motion it is ∓F_i. There is no chatter. The solution is a composition
of clips, so gradients exist almost everywhere. F = 0 gives f = 0 exactly. This method has first
order, which is enough for integrators of first order.

In reality, a joint comes to rest within the step and not at its end. Until then, friction is
against its motion. Afterwards friction holds the joint, or the joint breaks away if the other
forces exceed F_i. Two quantities are computed: the mean friction over the step, and the correction
of the position, because the joint moves less far than under the mean friction. Both are exact
under constant accelerations, so a reversal costs no accuracy. Bounds that depend on velocity are
evaluated at the middle of each of the two phases.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.common.integrators import Components

__all__ = ["DryFriction", "dry_friction_over_step", "solve_dry_friction", "stopping_friction"]

# Sweeps of projected Gauss–Seidel for more than two joints. With the strongest coupling among the
# included models, the Furuta pendulum's, a sweep reduces errors by 0.56, and 20 sweeps by 1e-5.
_NUM_SWEEPS = 20


class DryFriction(NamedTuple):
    """Dry friction over one step; ``None`` at joints without dry friction.

    Attributes:
        forces: Mean forces over the step.
        is_held: Whether friction has brought the joint to rest by the step's end.
        shortfalls: Corrections to add to the positions.
    """

    forces: tuple[Tensor | None, ...]
    is_held: tuple[Tensor | None, ...]
    shortfalls: tuple[Tensor | None, ...]


def stopping_friction(
    bounds: tuple[Tensor | None, ...],
    velocities: Components,
    accelerations: Components,
    inverse_inertia: tuple[Components, ...],
    step: float,
) -> DryFriction:
    """Returns dry friction that is constant over a step and stops joints at its end.

    It has first order and takes less than half the time of :func:`dry_friction_over_step`. For the
    arguments see :func:`solve_dry_friction`.
    """
    solved = solve_dry_friction(bounds, velocities, accelerations, inverse_inertia, step)
    forces: list[Tensor | None] = [None] * len(bounds)
    is_held = list(forces)
    for i, (bound, force) in enumerate(zip(bounds, solved, strict=True)):
        if bound is not None and isinstance(force, Tensor):
            forces[i], is_held[i] = force, force.abs() < bound
    return DryFriction(tuple(forces), tuple(is_held), (None,) * len(bounds))


def dry_friction_over_step(
    limits: tuple[Tensor | None, ...],
    bounds_at: Callable[[Components], tuple[Tensor | None, ...]],
    velocities: Components,
    accelerations: Components,
    inverse_inertia: tuple[Components, ...],
    step: float,
) -> DryFriction:
    """Returns the dry friction at each joint over a step in which joints may reverse.

    Args:
        limits: Greatest magnitude F_i per joint at the step's start, in its force unit; ``None``
            without friction.
        bounds_at: Function that returns these limits at other velocities.
        velocities: Velocities v at the step's start.
        accelerations: Accelerations a₀ without dry friction at the step's start.
        inverse_inertia: Rows of W, the acceleration of joint i per unit force at joint j.
        step: Length h of the step, in seconds.
    """

    def bounds(at: Mapping[int, Tensor]) -> dict[int, Tensor]:
        moving = tuple(at.get(i, v) for i, v in enumerate(velocities))
        return {i: bound for i, bound in enumerate(bounds_at(moving)) if bound is not None}

    first = {i: bound for i, bound in enumerate(limits) if bound is not None}
    resting = bounds({i: torch.zeros_like(velocities[i]) for i in first})
    # If a bound is the same tensor object at rest, it does not depend on the velocity.
    varies = any(resting[i] is not first[i] for i in first)
    w = {i: inverse_inertia[i][i] for i in first}
    free = _free_accelerations(first, velocities, accelerations, inverse_inertia, step)
    sliding = going_on = first
    if varies:
        middle: dict[int, Tensor] = {}
        for i, bound in first.items():
            v = velocities[i]
            a = _under(free[i], w[i], bound * v.sign())
            stops = _time_to_rest(v, a, bound, step) < step
            middle[i] = torch.where(stops, 0.5 * v, v + 0.5 * step * a)
        sliding = bounds(middle)
    against = {i: sliding[i] * velocities[i].sign() for i in first}
    time = {
        i: _time_to_rest(velocities[i], _under(free[i], w[i], against[i]), sliding[i], step)
        for i in first
    }
    if varies:
        excess = {i: _under(free[i], w[i], _clip(free[i] / w[i], resting[i])) for i in first}
        going_on = bounds({i: 0.5 * (step - time[i]) * excess[i] for i in first})

    forces: list[Tensor | None] = [None] * len(velocities)
    is_held, shortfalls = list(forces), list(forces)
    for i in first:
        left, needed = step - time[i], free[i] / w[i]
        last = _clip(needed, going_on[i])
        if varies:
            last = torch.where(needed.abs() <= resting[i], needed, last)
        forces[i] = torch.addcmul(last * left, against[i], time[i]) * (-1.0 / step)
        is_held[i] = (last == needed) & (left > 0.0)
        end = torch.addcmul(velocities[i], _under(free[i], w[i], last), time[i])
        shortfalls[i] = -0.5 * (end * left)
    return DryFriction(tuple(forces), tuple(is_held), tuple(shortfalls))


def _under(acceleration: Tensor, inverse_inertia: Tensor, friction: Tensor) -> Tensor:
    """Returns an acceleration minus the deceleration due to friction."""
    return torch.addcmul(acceleration, inverse_inertia, friction, value=-1.0)


def _free_accelerations(
    bounds: Mapping[int, Tensor],
    velocities: Components,
    accelerations: Components,
    inverse_inertia: tuple[Components, ...],
    step: float,
) -> dict[int, Tensor]:
    """Returns each joint's acceleration without its own friction, with that of the other joints.

    The other joints' friction is computed as if they stopped at the end of the step. Two joints
    rarely stop in the same step.
    """
    if len(bounds) == 1:
        return {i: accelerations[i] for i in bounds}
    limits = tuple(bounds.get(i) for i in range(len(velocities)))
    stopping = solve_dry_friction(limits, velocities, accelerations, inverse_inertia, step)
    return {
        i: accelerations[i] + sum(inverse_inertia[i][j] * stopping[j] for j in bounds if j != i)
        for i in bounds
    }


def _time_to_rest(velocity: Tensor, acceleration: Tensor, bound: Tensor, step: float) -> Tensor:
    """Returns the time after which a joint is at rest, in seconds.

    It is the whole step if the joint does not stop within it or has no friction.

    Args:
        velocity: Velocity at the step's start.
        acceleration: Acceleration under sliding friction.
        bound: Greatest magnitude of that friction.
        step: Length of the step, in seconds.
    """
    if acceleration.requires_grad:
        # Avoids the gradient infinity times zero, which is NaN.
        acceleration = torch.where(acceleration == 0.0, 1.0, acceleration)
    time = -velocity / acceleration
    return torch.where((time >= 0.0) & (bound > 0.0), time, step).clamp_max(step)


def solve_dry_friction(
    bounds: tuple[Tensor | None, ...],
    velocities: Components,
    accelerations: Components,
    inverse_inertia: tuple[Components, ...],
    step: float,
) -> tuple[Tensor | float, ...]:
    """Returns the dry friction at each joint, constant over the step.

    Args:
        bounds: Greatest magnitude F_i per joint, in its force unit; ``None`` without friction.
        velocities: Velocities v at the step's start.
        accelerations: Accelerations a₀ without dry friction at the step's start.
        inverse_inertia: Rows of W, the acceleration of joint i per unit force at joint j.
        step: Length h of the step, in seconds.

    Returns:
        The friction forces f, ``0.0`` at joints without friction.
    """
    limits = {i: bound for i, bound in enumerate(bounds) if bound is not None}
    joints = list(limits)
    forces: list[Tensor | float] = [0.0] * len(bounds)
    # At rest v + h a₀ + h W f = 0. It is divided by h, so h does not appear below.
    free = {i: velocities[i] / step + accelerations[i] for i in joints}
    w = inverse_inertia
    if len(joints) == 1:
        (i,) = joints
        forces[i] = _clip(-free[i] / w[i][i], limits[i])
    elif len(joints) == 2:
        i, j = joints
        forces[i], forces[j] = _solve_pair(free, w, limits, i, j)
    else:
        for _ in range(_NUM_SWEEPS):
            for i in joints:
                others = free[i]
                for j in joints:
                    if j != i:
                        others = others + w[i][j] * forces[j]
                forces[i] = _clip(-others / w[i][i], limits[i])
    return tuple(forces)


def _solve_pair(
    free: dict[int, Tensor],
    w: tuple[Components, ...],
    limits: dict[int, Tensor],
    i: int,
    j: int,
) -> tuple[Tensor, Tensor]:
    """Solves two coupled joints exactly.

    Eliminating f_i leaves one increasing, piecewise linear condition on f_j. It has three pieces:
    f_i at its lower bound, between the bounds, and at its upper bound. The condition is the median
    of three increasing lines, and the root of a median is the median of the roots.
    """
    wii, wij, wjj = w[i][i], w[i][j], w[j][j]
    coupling = wij.abs() * limits[i]
    inside = -(free[j] - wij / wii * free[i]) / (wjj - wij * wij / wii)
    first, last = (-free[j] - coupling) / wjj, (-free[j] + coupling) / wjj
    force_j = _clip(inside.clamp(first, last), limits[j])
    force_i = _clip(-(free[i] + wij * force_j) / wii, limits[i])
    return force_i, force_j


def _clip(force: Tensor, bound: Tensor) -> Tensor:
    """Clips a force to ±bound."""
    return force.clamp(-bound, bound)
