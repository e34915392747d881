"""Servos of a MuJoCo model: actuators whose force is a gain times an error, and their effects."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Tables
from npdr_ppl.engines.mujoco.fields import actuated_joint, follows_its_command, servo_gains
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effect_context import Servo
from npdr_ppl.language.effects import Effect, EnvironmentEffect, ServoEffect

__all__ = ["ServoErrors", "check_servo", "is_servo", "with_servos"]


def is_servo(model: Any, actuator: int) -> bool:
    """Returns whether an actuator follows a position or a velocity, which its command states."""
    return follows_its_command(model, actuator)


def with_servos(
    model: Any,
    names: Sequence[str],
    effects: Sequence[Effect],
    parameters: Sequence[Mapping[str, Tensor]],
    assignments: Assignments,
) -> Assignments:
    """Returns the values to write into the model after effects have changed its servos.

    Args:
        model: A ``mujoco.MjModel``.
        names: The port's name of each actuator.
        effects: All effects of a simulator.
        parameters: Parameters of each by short name, in float64.
        assignments: Values to write without these effects.
    """
    result = dict(assignments)
    for effect, values in zip(effects, parameters, strict=True):
        if not isinstance(effect, EnvironmentEffect) or effect.port not in names:
            continue
        actuator = names.index(effect.port)
        # A servo's error is taken from its position, the second number of the bias, or its
        # velocity, the third.
        column = 1 if "kp" in servo_gains(model, actuator) else 2
        gain = "actuator_gainprm", actuator * model.actuator_gainprm.shape[1]
        bias = "actuator_biasprm", actuator * model.actuator_biasprm.shape[1] + column
        old = Servo(present(model, *gain, result))
        new = effect.environment(old, values)
        if new.gain is not old.gain:
            result |= {gain: new.gain, bias: -new.gain}
        if new.limit is not old.limit:
            result |= _limited(model, actuator, new.limit, result)
    return result


def _limited(model: Any, actuator: int, limit: Tensor, assignments: Assignments) -> Assignments:
    """Returns a servo's range of forces with a further limit, a number or ``(N,)``."""
    lower, upper = (("actuator_forcerange", 2 * actuator + i) for i in range(2))
    if not model.actuator_forcelimited[actuator]:
        return {lower: -limit, upper: limit}
    least, most = (present(model, *place, assignments) for place in (lower, upper))
    return {lower: torch.maximum(least, -limit), upper: torch.minimum(most, limit)}


def check_servo(model: Any, actuator: int, effect: str) -> None:
    """Raises a ModelError if the error of an actuator is not its goal minus its joint's position.

    Args:
        model: A ``mujoco.MjModel``.
        actuator: Number of the actuator.
        effect: Name of the effect that needs the error.
    """
    has_state = int(model.actuator_dyntype[actuator]) != 0
    if (
        has_state
        or actuated_joint(model, actuator) is None
        or not follows_its_command(model, actuator)
        or "kp" not in servo_gains(model, actuator)
    ):
        raise ModelError(
            f"{effect} needs a position servo that acts on a joint without a filter of its own."
        )


class ServoErrors:
    """Changes the goals of position servos so that they act on the errors that effects give.

    The servos act on a joint directly, with a gear of one. The engine holds a goal during a step.
    So an effect acts with its state in the middle of the step, and its next state follows from
    the error there, e − ½ h v. ``RK4`` computes the servo's force several times within a step;
    its goal is shifted by what the effect changes at the error in the middle, so that the result
    is right to second order. All other integrators are of first order: their goal is shifted by
    the change at the error as the step begins, which damps more.

    Args:
        model: A ``mujoco.MjModel``.
        effects: Index in the tables, effect and number of the actuator of each effect.
        goals: The batch's live view of the commands, ``(N, actuators)``.
        positions: Its live view of ``qpos``.
        velocities: Its live view of ``qvel``.
        is_fourth: Whether the integrator is ``RK4``.
    """

    def __init__(
        self,
        model: Any,
        effects: Sequence[tuple[int, ServoEffect, int]],
        goals: NDArray[np.float64],
        positions: NDArray[np.float64],
        velocities: NDArray[np.float64],
        *,
        is_fourth: bool,
    ) -> None:
        self._effects, self._is_fourth = effects, is_fourth
        self._goals, self._positions, self._velocities = goals, positions, velocities
        joints = {actuator: actuated_joint(model, actuator) for _, _, actuator in effects}
        self._position_address = {a: int(model.jnt_qposadr[joint]) for a, joint in joints.items()}
        self._velocity_address = {a: int(model.jnt_dofadr[joint]) for a, joint in joints.items()}

    def initial_memory(self) -> tuple[Tensor | None, ...]:
        """Returns the own state of each effect as a rollout begins, at its servo's goal."""
        at_goal = torch.zeros(len(self._goals), dtype=torch.float64)
        return tuple(effect.initial_memory(at_goal) for _, effect, _ in self._effects)

    def apply(
        self, tables: Tables, memory: tuple[Tensor | None, ...], time_step: float
    ) -> tuple[Tensor | None, ...]:
        """Changes the goals in the present state, and returns the memory after the step.

        Args:
            tables: Parameters of the effects.
            memory: Own state of each effect.
            time_step: Seconds per engine step.
        """
        later: list[Tensor | None] = []
        means: dict[int, Tensor] = {}
        for (place, effect, actuator), own in zip(self._effects, memory, strict=True):
            values = tables.effects[place]
            position = self._positions[:, self._position_address[actuator]]
            error = torch.from_numpy(self._goals[:, actuator] - position)
            velocity = torch.from_numpy(self._velocities[:, self._velocity_address[actuator]])
            mean = means.get(actuator, error - 0.5 * time_step * velocity)
            middle = effect.next_memory(error, values, own, 0.5 * time_step)
            means[actuator] = effect.act(mean, values, middle)
            if self._is_fourth:
                change = means[actuator] - mean
            else:
                change = effect.act(error, values, middle) - error
            self._goals[:, actuator] += change.numpy()
            later.append(effect.next_memory(mean, values, own, time_step))
        return tuple(later)
