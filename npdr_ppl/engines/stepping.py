"""One step of a mechanical system with its effects: what open and closed loop share."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.dry_friction import solve_dry_friction
from npdr_ppl.engines.effect_chain import EffectChain, State, Tables
from npdr_ppl.engines.integrators import Components

if TYPE_CHECKING:
    from npdr_ppl.engines.ode import ODESimulator

__all__ = ["State", "Stepper", "Tables", "flatten"]


class Stepper(EffectChain):
    """Advances states by one time step under the effects attached to a simulator.

    Args:
        simulator: The system and its effects.
        time_step: Seconds per step.
        histories: Past commands that each action effect may ask for.
    """

    def __init__(
        self, simulator: "ODESimulator", time_step: float, histories: tuple[int, ...]
    ) -> None:
        super().__init__(simulator, simulator.joints, time_step, histories)
        self.simulator: ODESimulator = simulator
        self._substep = time_step / simulator.substeps

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel."""
        return self.simulator.readings(positions, velocities, tables.constants)

    def move(self, state: State, actions: Components, tables: Tables) -> State:
        """Advances the dynamics by one time step under constant actions."""
        for _ in range(self.simulator.substeps):
            state = self._move_once(state, actions, tables)
        return state

    def _move_once(self, state: State, actions: Components, tables: Tables) -> State:
        """Advances the dynamics by one substep."""
        simulator, constants = self.simulator, tables.constants
        start = state.positions, state.velocities
        dry: tuple[Any, ...] = (0.0,) * len(state.positions)

        def acceleration(positions: Components, velocities: Components) -> Components:
            forces = self._forces(positions, velocities, state, tables, dry)
            return simulator.accelerations(positions, velocities, actions, forces, constants)

        first = acceleration(*start)
        bounds = self.dry_friction_bounds(state, tables)
        has_dry_friction = any(bound is not None for bound in bounds)
        if has_dry_friction:
            forces = self._forces(*start, state, tables, dry)
            inertia = simulator.inverse_inertia(*start, constants) or _probe_inverse_inertia(
                simulator, *start, actions, forces, constants, first
            )
            dry = solve_dry_friction(bounds, state.velocities, first, inertia, self._substep)
            # Accelerations are affine in the forces, so the first evaluation is not repeated.
            first = tuple(
                a + sum(w * f for w, f, b in zip(row, dry, bounds, strict=True) if b is not None)
                for a, row in zip(first, inertia, strict=True)
            )
        q, v = simulator.integrator.step(acceleration, *start, first, self._substep)
        if has_dry_friction:
            # Friction within its bound has stopped the joint; rounding must not leave a velocity
            # whose sign then means something to a policy.
            v = tuple(
                vi if b is None else torch.where(f.abs() < b, 0.0, vi)
                for vi, f, b in zip(v, dry, bounds, strict=True)
            )
        memory = self.next_force_memory(state, tables, self._substep)
        return state._replace(positions=q, velocities=v, force_memory=memory)

    def _forces(
        self,
        positions: Components,
        velocities: Components,
        state: State,
        tables: Tables,
        dry: tuple[Any, ...],
    ) -> tuple[Any, ...]:
        """Returns the smooth forces in a state of the integrator, on top of the dry ones."""
        forces = list(dry)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            force = effect.force(
                positions[joint], velocities[joint], tables.effects[place], state.force_memory[k]
            )
            if force is not None:
                forces[joint] = forces[joint] + force
        return tuple(forces)


def _probe_inverse_inertia(
    simulator: "ODESimulator",
    positions: Components,
    velocities: Components,
    actions: Components,
    forces: tuple[Any, ...],
    constants: Any,
    accelerations: Components,
) -> tuple[Components, ...]:
    """Returns the rows of W by applying a unit force at one joint after the other."""
    columns = []
    for joint in range(len(positions)):
        pushed = tuple(f + 1.0 if i == joint else f for i, f in enumerate(forces))
        moved = simulator.accelerations(positions, velocities, actions, pushed, constants)
        columns.append(tuple(b - a for a, b in zip(accelerations, moved, strict=True)))
    return tuple(zip(*columns, strict=True))


def flatten(tree: Any, shape: torch.Size, *, expand: bool = False) -> Any:
    """Returns the tree with every tensor expanded to ``shape`` and flat.

    One flat axis vectorises well whatever the batch's shape is.

    Args:
        tree: Nested tuples and dictionaries of tensors that broadcast to ``shape``.
        shape: The batch's shape.
        expand: Whether to expand single numbers too: a compiled kernel should not depend on which
            parameters happen to vary.
    """

    def flat(leaf: Tensor) -> Tensor:
        if leaf.numel() == 1 and not expand:
            return leaf.reshape(())
        # A single number expands to a view with stride 0, which would be a kernel of its own.
        return leaf.expand(shape).reshape(-1).contiguous()

    return pytree.tree_map_only(Tensor, flat, tree)
