"""Motion of a function of a batch under effects on forces, simulated one step at a time."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.dry_friction import dry_friction_over_step
from npdr_ppl.engines.common.effect_chain import EffectChain
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.effect_context import Joint
from npdr_ppl.language.simulator import Simulator

__all__ = ["Advance", "ForcedMotion"]

Advance = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Advances all simulations by one step: from states ``(N, states)``, actions ``(N, actions)`` and
forces ``(N, forces)`` to states ``(N, states)``."""

Forces = tuple[Tensor | None, ...]
"""Force of the effects at each port, ``(N,)``; ``None`` for zero."""

PUSH = 1e-3
"""Force that measures a joint's inverse inertia, as a fraction of the port's rated force: small
enough for a function that is not quite affine in it, and far above rounding errors."""


class ForcedMotion(EffectChain):
    """Computes the forces of effects during each step, and passes them to a function.

    The function holds a force for a step. Smooth forces are those in the middle of the step, which
    is known from a first simulation of it without a change of the forces (the midpoint method, of
    second order). Dry friction follows from the function's response to a small force, as in
    :mod:`~npdr_ppl.engines.common.dry_friction`.

    Args:
        simulator: Declares states and ports, and has effects on forces only.
        joints: Name of the force port by the column of the position that it acts on.
        rates: Column of the velocity of each of these positions.
        advance: The function.
        time_step: Seconds per step.
    """

    def __init__(
        self,
        simulator: Simulator,
        joints: Mapping[int, str],
        rates: tuple[int, ...],
        advance: Advance,
        time_step: float,
    ) -> None:
        super().__init__(simulator, tuple(joints.values()), time_step, ())
        self._positions = tuple(joints)
        self._rates = rates
        self._advance = advance
        self._pushes = [PUSH * simulator.port(name).rated for name in joints.values()]

    def run(
        self,
        effects: tuple[dict[str, Tensor], ...],
        initial_states: Tensor,
        actions: Tensor,
        time: Tensor,
    ) -> Tensor:
        """Returns the states after each step, ``(N, steps, states)``.

        Args:
            effects: Parameters of each effect by short name, ``(N,)`` each.
            initial_states: ``(N, states)``.
            actions: ``(N, steps, actions)``.
            time: Seconds since the rollout began, ``(N,)``.
        """
        tables = Tables(None, effects)
        states = initial_states
        memory = self.start(*self._joints_of(states), tables, (), (), time)
        result = []
        for action in actions.unbind(1):
            states, memory = self._step(states, memory, action, tables)
            result.append(states)
        return torch.stack(result, dim=1) if result else initial_states[:, None][:, :0]

    def _step(
        self, states: Tensor, memory: State, action: Tensor, tables: Tables
    ) -> tuple[Tensor, State]:
        q, v = self._joints_of(states)
        memory = memory._replace(positions=q, velocities=v)
        if self.forces.needs_joints:
            memory = self.forces.begin_step(
                memory, self._joints(states, memory, action, tables), tables
            )
        forces = self.forces.smooth_forces(q, v, memory, tables)
        end = self._end(states, action, forces)
        if any(force is not None for force in forces):
            middle = self._joints_of(0.5 * (states + end))
            forces = self.forces.smooth_forces(*middle, memory, tables)
            end = self._end(states, action, forces)
        bounds = self.forces.dry_friction_bounds(memory, tables)
        if any(bound is not None for bound in bounds):
            end = self._with_dry_friction(states, end, memory, action, forces, bounds, tables)
        return end, memory._replace(force_memory=self.forces.next_memory(memory, tables))

    def _with_dry_friction(
        self,
        states: Tensor,
        end: Tensor,
        memory: State,
        action: Tensor,
        forces: Forces,
        bounds: Forces,
        tables: Tables,
    ) -> Tensor:
        """Returns the states after a step with dry friction; ``end`` is without it."""

        def bounds_at(velocities: Components) -> Forces:
            return self.forces.dry_friction_bounds(memory._replace(velocities=velocities), tables)

        free = self._accelerations(states, end)
        inertia = self._inverse_inertia(states, action, forces, free)
        friction = dry_friction_over_step(
            bounds, bounds_at, memory.velocities, free, inertia, self.time_step
        )
        total = tuple(_sum(f, dry) for f, dry in zip(forces, friction.forces, strict=True))
        columns = list(self._end(states, action, total).unbind(-1))
        for place, (held, shortfall) in enumerate(
            zip(friction.is_held, friction.shortfalls, strict=True)
        ):
            position, rate = self._positions[place], self._rates[place]
            if held is not None:
                columns[rate] = torch.where(held, 0.0, columns[rate])
            if shortfall is not None:
                columns[position] = columns[position] + shortfall
        return torch.stack(columns, dim=-1)

    def _joints(
        self, states: Tensor, memory: State, action: Tensor, tables: Tables
    ) -> tuple[Joint, ...]:
        """Returns the joints before the forces of the effects that need them are applied."""
        q, v = memory.positions, memory.velocities
        forces = self.forces.smooth_forces(q, v, memory, tables, before_step=True)
        accelerations = self._accelerations(states, self._end(states, action, forces))
        inertia = self._inverse_inertia(states, action, forces, accelerations)
        still = self._accelerations(states, self._end(states, torch.zeros_like(action), forces))
        gained = torch.stack([a - b for a, b in zip(accelerations, still, strict=True)], dim=-1)
        matrix = torch.stack([torch.stack(row, dim=-1) for row in inertia], dim=-2)
        drive = torch.linalg.solve(matrix, gained).unbind(-1)
        return tuple(
            Joint(q[i], v[i], accelerations[i], inertia[i][i], drive[i]) for i in range(len(q))
        )

    def _inverse_inertia(
        self, states: Tensor, action: Tensor, forces: Forces, accelerations: Components
    ) -> tuple[Components, ...]:
        """Returns the rows of W, the acceleration of joint i per unit force at joint j."""
        columns = []
        for place, push in enumerate(self._pushes):
            pushed = list(forces)
            pushed[place] = _sum(forces[place], torch.full_like(states[:, 0], push))
            moved = self._accelerations(states, self._end(states, action, tuple(pushed)))
            columns.append(
                tuple((b - a) / push for a, b in zip(accelerations, moved, strict=True))
            )
        return tuple(zip(*columns, strict=True))

    def _end(self, states: Tensor, action: Tensor, forces: Forces) -> Tensor:
        """Returns the states after a step under constant forces."""
        zero = torch.zeros_like(states[:, 0])
        columns = [zero if f is None else f.expand_as(zero) for f in forces]
        return self._advance(states, action, torch.stack(columns, dim=-1))

    def _accelerations(self, states: Tensor, end: Tensor) -> Components:
        """Returns the mean acceleration of each joint over a step."""
        before, after = self._joints_of(states)[1], self._joints_of(end)[1]
        return tuple((b - a) / self.time_step for a, b in zip(before, after, strict=True))

    def _joints_of(self, states: Tensor) -> tuple[Components, Components]:
        """Returns position and velocity at each force port."""
        return (
            tuple(states[:, column] for column in self._positions),
            tuple(states[:, column] for column in self._rates),
        )

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Not used; effects on measurements are applied outside."""
        raise NotImplementedError

    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Not used; see :meth:`run`."""
        raise NotImplementedError


def _sum(force: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Adds two forces of which ``None`` is zero."""
    if force is None or other is None:
        return other if force is None else force
    return force + other
