"""The force effects of a simulator: their forces and dry friction during a step."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from npdr_ppl.engines.common.chain_state import State, Tables, add_to
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.past_motion import PastMotion
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import ForceEffect
from npdr_ppl.language.simulator import Simulator

__all__ = ["ForceEffects"]


class ForceEffects:
    """Sums the forces of effects at each joint.

    Args:
        simulator: The system and its effects.
        joints: Names of the force ports, in the order of the coordinates that they act on.
        time_step: Seconds between two evaluations of the forces.

    Attributes:
        effects: Index in ``Tables.effects``, effect and joint of each effect.
        needs_joints: Whether an effect needs a :class:`Joint` before every step.
        needs_only_drives: Whether no effect needs more of it than its drive.
    """

    def __init__(self, simulator: Simulator, joints: tuple[str, ...], time_step: float) -> None:
        self.effects: list[tuple[int, ForceEffect, int]] = [
            (place, effect, joints.index(effect.port))
            for place, effect in enumerate(simulator.effects)
            if isinstance(effect, ForceEffect)
        ]
        in_need = [effect for _, effect, _ in self.effects if effect.needs_joint]
        self.needs_joints = bool(in_need)
        self.needs_only_drives = all(effect.needs_only_drive for effect in in_need)
        self._joints = joints
        self._time_step = time_step

    def initial_memory(
        self,
        positions: Components,
        velocities: Components,
        tables: Tables,
        time: Tensor,
        past_motion: PastMotion,
    ) -> tuple[Any, ...]:
        """Returns the effects' own state at the start of an episode or segment.

        Args:
            positions: Position of each joint, ``(N,)`` each.
            velocities: Their rates.
            tables: Constants of the simulation.
            time: Seconds since the rollout began, ``(N,)``.
            past_motion: Motion of the joints before the start.
        """
        return tuple(
            effect.initial_memory(
                positions[joint],
                velocities[joint],
                past_motion.put_into(Start(time, self._time_step, tables.effects[place]), joint),
            )
            for place, effect, joint in self.effects
        )

    def begin_step(self, state: State, joints: Sequence[Joint | None], tables: Tables) -> State:
        """Passes the joints to the effects that need them.

        Args:
            state: State at the step's start.
            joints: Each joint; ``None`` if no effect needs it.
            tables: Constants of the simulation.
        """
        memory = list(state.force_memory)
        for k, (place, effect, joint) in enumerate(self.effects):
            seen = joints[joint]
            if effect.needs_joint and seen is not None:
                others = zip(self._joints, joints, strict=True)
                seen = seen._replace(
                    others={
                        name: (other.position, other.velocity)
                        for place_of_other, (name, other) in enumerate(others)
                        if other is not None and place_of_other != joint
                    }
                )
                memory[k] = effect.begin_step(
                    seen, tables.effects[place], memory[k], self._time_step
                )
        return state._replace(force_memory=tuple(memory))

    def smooth_forces(
        self,
        positions: Components,
        velocities: Components,
        state: State,
        tables: Tables,
        *,
        before_step: bool = False,
    ) -> tuple[Tensor | None, ...]:
        """Returns the sum of smooth forces at each joint; ``None`` if there is no force.

        Args:
            positions: Position of each joint, ``(N,)`` each.
            velocities: Their rates.
            state: State with the effects' memory.
            tables: Constants of the simulation.
            before_step: Whether to leave out effects that still need their :class:`Joint`.
        """
        forces: list[Tensor | None] = [None] * len(positions)
        for k, (place, effect, joint) in enumerate(self.effects):
            if before_step and effect.needs_joint:
                continue
            force = effect.force(
                positions[joint], velocities[joint], tables.effects[place], state.force_memory[k]
            )
            add_to(forces, joint, force)
        return tuple(forces)

    def moments(self, state: State, tables: Tables) -> tuple[Tensor | None, ...]:
        """Returns the moments of the forces within the present step, per joint."""
        moments: list[Tensor | None] = [None] * len(state.positions)
        for k, (place, effect, joint) in enumerate(self.effects):
            if effect.needs_joint:
                moment = effect.moment(tables.effects[place], state.force_memory[k])
                add_to(moments, joint, moment)
        return tuple(moments)

    def dry_friction_bounds(self, state: State, tables: Tables) -> tuple[Tensor | None, ...]:
        """Returns the summed bounds of dry friction per joint."""
        bounds: list[Tensor | None] = [None] * len(state.positions)
        for k, (place, effect, joint) in enumerate(self.effects):
            bound = effect.dry_friction(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
            )
            add_to(bounds, joint, bound)
        return tuple(bounds)

    def next_memory(self, state: State, tables: Tables) -> tuple[Any, ...]:
        """Returns the effects' own state at their next evaluation."""
        return tuple(
            effect.next_memory(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
                self._time_step,
            )
            for k, (place, effect, joint) in enumerate(self.effects)
        )
