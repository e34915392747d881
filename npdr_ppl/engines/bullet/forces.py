"""Effects on the forces at joints, applied before every substep."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.engines.bullet.scene import Scene
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import ForceEffect

__all__ = ["JointForces", "is_dry"]

Joint = tuple[int, int]


def is_dry(effect: ForceEffect) -> bool:
    """Returns whether an effect contains dry friction."""
    return type(effect).dry_friction is not ForceEffect.dry_friction


class JointForces:
    """The forces of effects at the joints of a scene.

    Smooth forces are evaluated in the state at a substep's start. Dry friction uses Bullet's joint
    motor with a target velocity of zero and the friction's bound as its greatest force. The solver
    then finds the force of Coulomb's law within the substep, including stiction.

    Args:
        scene: The scene, in its initial state.
        effects: Effects, each with its joint.
        parameters: Values of all their parameters.
        time_step: Seconds per substep.
        start_time: Seconds since the rollout began.
    """

    def __init__(
        self,
        scene: Scene,
        effects: Sequence[tuple[ForceEffect, Joint]],
        parameters: Mapping[str, float],
        time_step: float,
        start_time: float,
    ) -> None:
        client = scene.client
        self._state = client.getJointState
        self._control = client.setJointMotorControl2
        self._velocity_control = client.VELOCITY_CONTROL
        self._time_step = time_step
        values = {
            name: torch.tensor(value, dtype=torch.float64) for name, value in parameters.items()
        }
        self._effects = [
            (effect, joint, effect.own_parameters(values)) for effect, joint in effects
        ]
        time = torch.tensor(start_time, dtype=torch.float64)
        self._memory: list[Any] = [
            effect.initial_memory(*self._motion(joint), Start(time, time_step, own))
            for effect, joint, own in self._effects
        ]

    def __call__(self) -> dict[Joint, float]:
        """Sets dry friction, advances the effects, and returns the smooth forces by joint."""
        forces: dict[Joint, float] = {}
        bounds: dict[Joint, float] = {}
        for place, (effect, joint, own) in enumerate(self._effects):
            motion, memory = self._motion(joint), self._memory[place]
            force = effect.force(*motion, own, memory)
            if force is not None:
                forces[joint] = forces.get(joint, 0.0) + float(force)
            bound = effect.dry_friction(*motion, own, memory)
            if bound is not None:
                bounds[joint] = bounds.get(joint, 0.0) + float(bound)
            self._memory[place] = effect.next_memory(*motion, own, memory, self._time_step)
        for joint, bound in bounds.items():
            self._control(*joint, self._velocity_control, targetVelocity=0.0, force=bound)
        return forces

    def _motion(self, joint: Joint) -> tuple[Tensor, Tensor]:
        position, velocity = self._state(*joint)[:2]
        return (
            torch.tensor(position, dtype=torch.float64),
            torch.tensor(velocity, dtype=torch.float64),
        )
