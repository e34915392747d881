"""One step of a mechanical system with its effects, for recorded actions and for policies."""

from typing import Any

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.dry_friction import (
    DryFriction,
    dry_friction_over_step,
    stopping_friction,
)
from npdr_ppl.engines.common.effect_chain import EffectChain
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.ode.mechanical_system import MechanicalSystem
from npdr_ppl.language.effect_context import Joint

__all__ = ["Stepper", "forces_of"]

SINGULAR = 1e-9
"""Smallest pivot or determinant of a matrix that is not singular, relative to its parts. Rounding
errors of computed rows are about 1e-13; light parts of a heavy robot have ratios above 1e-6."""

_LEAST_ORDER_FOR_BENDS = 3
"""Order from which on positions tell how velocities move within a step."""


class Stepper(EffectChain):
    """Advances states by one time step under the effects attached to a simulator.

    Args:
        simulator: The system and its effects.
        time_step: Seconds per step.
        histories: Number of past commands that each action effect may need, then of past values
            that each sensor effect may need.
    """

    def __init__(
        self, simulator: MechanicalSystem, time_step: float, histories: tuple[int, ...]
    ) -> None:
        substep = time_step / simulator.substeps
        # Below third order, the error of a step's position is as large as what the velocity's bend
        # adds to it, O(h³).
        rate_lag = 0.0 if simulator.integrator.order >= _LEAST_ORDER_FOR_BENDS else None
        super().__init__(
            simulator,
            simulator.joints,
            time_step,
            histories,
            force_step=substep,
            rate_lag=rate_lag,
        )
        self.simulator: MechanicalSystem = simulator
        self._substep = substep
        # With a first-order integrator, moments would not make the positions more accurate.
        self._takes_moments = simulator.integrator.order > 1

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel."""
        return self.simulator.readings(positions, velocities, tables.constants)

    def accelerations(
        self, positions: Components, velocities: Components, actions: Components, tables: Tables
    ) -> Components:
        """Returns the accelerations without any effect."""
        none = (0.0,) * len(positions)
        return self.simulator.accelerations(positions, velocities, actions, none, tables.constants)

    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Advances the dynamics by one time step; see :meth:`EffectChain.move`."""
        means, left = self.actions.by_substep(actions, moments, self.simulator.substeps)
        for present in means:
            state = self._move_once(state, present, left, tables)
        return state

    def _move_once(
        self, state: State, actions: Components, moments: Moments, tables: Tables
    ) -> State:
        """Advances the dynamics by one substep."""
        if self.forces.needs_joints:
            state = self.forces.begin_step(state, self._joints(state, actions, tables), tables)
        simulator, constants = self.simulator, tables.constants
        start = state.positions, state.velocities
        dry: tuple[Any, ...] = (0.0,) * len(state.positions)

        def acceleration(positions: Components, velocities: Components) -> Components:
            smooth = self._forces(positions, velocities, state, tables, dry)
            return simulator.accelerations(positions, velocities, actions, smooth, constants)

        forces = self._forces(*start, state, tables, dry)
        first = even = simulator.accelerations(*start, actions, forces, constants)
        within = self.forces.moments(state, tables)
        is_uneven = any(moment is not None for moment in (*moments, *within))
        shifts: Components | None = None
        if self._takes_moments and is_uneven:
            # Positions change by ∫ (h − t) a dt; the integrator uses ½ h² times the mean of a.
            late = simulator.accelerations(
                *start, _shifted(actions, moments), _shifted(forces, within), constants
            )
            shifts = tuple(a - b for a, b in zip(even, late, strict=True))

        def bounds_at(velocities: Components) -> tuple[Tensor | None, ...]:
            return self.forces.dry_friction_bounds(state._replace(velocities=velocities), tables)

        bounds = self.forces.dry_friction_bounds(state, tables)
        friction: DryFriction | None = None
        if any(bound is not None for bound in bounds):
            inertia = _inverse_inertia(simulator, *start, actions, forces, constants, first)
            given = state.velocities, first, inertia, self._substep
            if simulator.integrator.order == 1:
                friction = stopping_friction(bounds, *given)
            else:
                friction = dry_friction_over_step(bounds, bounds_at, *given)
            dry = tuple(0.0 if force is None else force for force in friction.forces)
            # Accelerations are affine in the forces, so the first evaluation can be corrected.
            for joint, force in enumerate(friction.forces):
                if force is not None:
                    # A fused operation rounds differently and would let a held joint creep.
                    first = tuple(
                        a + row[joint] * force for a, row in zip(first, inertia, strict=True)
                    )
        q, v = simulator.integrator.step(acceleration, *start, first, self._substep)
        if shifts is not None:
            q = tuple(qi + shift for qi, shift in zip(q, shifts, strict=True))
        if shifts is not None and any(moment is not None for moment in within):
            # A joint that moved further was faster during the step and was damped more. Forces of
            # springs and impacts move joints far within a step. For a changing command, this
            # correction is below a hundredth of its delay, so it is left out.
            h = self._substep
            faster = tuple(
                vi + shift / h for vi, shift in zip(state.velocities, shifts, strict=True)
            )
            damped = simulator.accelerations(state.positions, faster, actions, forces, constants)
            v = tuple(vi + h * (b - a) for vi, a, b in zip(v, even, damped, strict=True))
        if friction is not None:
            # A policy may use the sign of a velocity, so rounding errors at rest are set to zero.
            v = tuple(
                vi if held is None else torch.where(held, 0.0, vi)
                for vi, held in zip(v, friction.is_held, strict=True)
            )
            q = tuple(
                qi if shortfall is None else qi + shortfall
                for qi, shortfall in zip(q, friction.shortfalls, strict=True)
            )
        memory = self.forces.next_memory(state, tables)
        return state._replace(positions=q, velocities=v, force_memory=memory)

    def _joints(self, state: State, actions: Components, tables: Tables) -> tuple[Joint, ...]:
        """Returns the joints before the forces of the effects that need them are applied."""
        simulator, constants = self.simulator, tables.constants
        q, v = state.positions, state.velocities
        forces = self._forces(q, v, state, tables, (0.0,) * len(q), before_step=True)
        acceleration = simulator.accelerations(q, v, actions, forces, constants)
        inertia = _inverse_inertia(simulator, q, v, actions, forces, constants, acceleration)
        drive = _drive_forces(simulator, q, v, actions, forces, constants, acceleration, inertia)
        return tuple(
            Joint(q[i], v[i], acceleration[i], inertia[i][i], drive[i], self._takes_moments)
            for i in range(len(q))
        )

    def _forces(
        self,
        positions: Components,
        velocities: Components,
        state: State,
        tables: Tables,
        dry: tuple[Any, ...],
        *,
        before_step: bool = False,
    ) -> tuple[Any, ...]:
        """Returns the sum of smooth forces in a state of the integrator and dry friction."""
        if not self.forces.effects:
            return dry
        smooth = self.forces.smooth_forces(
            positions, velocities, state, tables, before_step=before_step
        )
        # Without dry friction, d is the number zero, and adding it would be an operation more.
        return tuple(
            d if f is None else (d + f if isinstance(d, Tensor) else f)
            for d, f in zip(dry, smooth, strict=True)
        )


def _shifted(values: tuple[Any, ...], moments: Moments) -> tuple[Any, ...]:
    """Returns actions or forces plus their moments; an empty ``moments`` adds nothing."""
    if not moments:
        return values
    return tuple(v if m is None else v + m for v, m in zip(values, moments, strict=True))


def _inverse_inertia(
    simulator: MechanicalSystem,
    positions: Components,
    velocities: Components,
    actions: Components,
    forces: tuple[Any, ...],
    constants: Any,
    accelerations: Components,
) -> tuple[Components, ...]:
    """Returns the rows of W = ∂a/∂f, as declared, or else computed with unit forces."""
    declared = simulator.inverse_inertia(positions, velocities, constants)
    if declared:
        return declared
    columns = []
    for joint in range(len(positions)):
        pushed = tuple(f + 1.0 if i == joint else f for i, f in enumerate(forces))
        moved = simulator.accelerations(positions, velocities, actions, pushed, constants)
        columns.append(tuple(b - a for a, b in zip(accelerations, moved, strict=True)))
    return tuple(zip(*columns, strict=True))


def _drive_forces(
    simulator: MechanicalSystem,
    positions: Components,
    velocities: Components,
    actions: Components,
    forces: tuple[Any, ...],
    constants: Any,
    accelerations: Components,
    inertia: tuple[Components, ...],
) -> Components:
    """Returns the generalised forces τ of the actions: W τ = a(u) − a(0)."""
    still = tuple(torch.zeros_like(action) for action in actions)
    without = simulator.accelerations(positions, velocities, still, forces, constants)
    gained = tuple(a - b for a, b in zip(accelerations, without, strict=True))
    return forces_of(gained, inertia)


def forces_of(accelerations: Components, inertia: tuple[Components, ...]) -> Components:
    """Returns the generalised forces τ that cause accelerations: W τ = a.

    Where positions depend on each other, as the heading of a base on its two wheels, W is singular
    and many forces cause them; those with the smallest norm are returned.

    Args:
        accelerations: The accelerations a, ``(m,)`` each.
        inertia: The rows of W, ``(m,)`` each entry.
    """
    if len(accelerations) == 1:
        return (accelerations[0] / inertia[0][0],)
    if len(accelerations) == 2:
        return _forces_of_two(accelerations, inertia)
    size = accelerations[0].shape
    rows = [torch.stack([_tensor(e, size) for e in row], dim=-1) for row in inertia]
    matrix, wanted = torch.stack(rows, dim=-2), torch.stack(accelerations, dim=-1)[..., None]
    factors, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    found = torch.linalg.lu_solve(factors, pivots, wanted)[..., 0]
    sizes = factors.diagonal(dim1=-2, dim2=-1).abs()
    # A simulation that has diverged stays as it is.
    is_singular = (sizes.amin(-1) <= _least(matrix) * sizes.amax(-1)) & matrix.isfinite().all(
        -1
    ).all(-1)
    if bool(is_singular.any()):
        inverse = torch.linalg.pinv(matrix[is_singular], rtol=_least(matrix))
        found[is_singular] = (inverse @ wanted[is_singular])[..., 0]
    return found.unbind(-1)


def _forces_of_two(accelerations: Components, inertia: tuple[Components, ...]) -> Components:
    """Returns the forces of two joints without a branch, so that it can be compiled."""
    x, y = accelerations
    (a, b), (c, d) = ([_tensor(entry, x.shape) for entry in row] for row in inertia)
    determinant = a * d - b * c
    is_singular = determinant.abs() <= _least(x) * ((a * d).abs() + (b * c).abs())
    regular = torch.where(is_singular, 1.0, determinant)
    # The pseudoinverse of a matrix of rank one is its transpose over the sum of its squares.
    squares = (a * a + b * b + c * c + d * d).clamp_min(torch.finfo(x.dtype).tiny)
    return (
        torch.where(is_singular, (a * x + c * y) / squares, (d * x - b * y) / regular),
        torch.where(is_singular, (b * x + d * y) / squares, (a * y - c * x) / regular),
    )


def _tensor(entry: Tensor | float, size: torch.Size) -> Tensor:
    """Returns an entry of W, which may be declared as a number, for each simulation."""
    return torch.as_tensor(entry).expand(size)


def _least(values: Tensor) -> float:
    """Returns the pivot below which a matrix is singular, for the precision of its values."""
    return max(SINGULAR, 16.0 * torch.finfo(values.dtype).eps)
