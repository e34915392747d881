"""Servos of a MuJoCo model: actuators whose force is a gain times an error, and their effects."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.effect_chain import Tables
from npdr_ppl.engines.mujoco.fields import actuated_joint, servo_gains
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.language.effect_context import Servo
from npdr_ppl.language.effects import Effect, EnvironmentEffect, ServoEffect

__all__ = ["ServoForces", "is_servo", "servo_gain", "with_servos"]


def is_servo(model: Any, actuator: int) -> bool:
    """Returns whether an actuator follows a position or a velocity."""
    return bool(servo_gains(model, actuator))


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
        gain = _gain_place(model, actuator)
        bias = "actuator_biasprm", actuator * model.actuator_biasprm.shape[1] + column
        lower, upper = (("actuator_forcerange", 2 * actuator + i) for i in range(2))
        limit = torch.tensor(math.inf, dtype=torch.float64)
        if model.actuator_forcelimited[actuator]:
            limit = present(model, *upper, result)
        old = Servo(present(model, *gain, result), limit)
        new = effect.environment(old, values)
        if new.gain is not old.gain:
            result |= {gain: new.gain, bias: -new.gain}
        if new.limit is not old.limit:
            result |= {lower: -new.limit, upper: new.limit}
    return result


def servo_gain(model: Any, actuator: int, assignments: Assignments) -> Tensor:
    """Returns a servo's force per unit of error, a number or ``(N,)``.

    Args:
        model: A ``mujoco.MjModel``.
        actuator: The servo's number.
        assignments: What is written into the model.
    """
    return present(model, *_gain_place(model, actuator), assignments)


def _gain_place(model: Any, actuator: int) -> tuple[str, int]:
    return "actuator_gainprm", actuator * model.actuator_gainprm.shape[1]


class ServoForces:
    """Forces that effects inside position servos add to those of the engine.

    The servos act on a joint directly, with a gear of one.

    Args:
        model: A ``mujoco.MjModel``.
        effects: Index in the tables, effect and number of the actuator of each effect.
        goals: The batch's live view of the commands, ``(N, actuators)``.
        positions: Its live view of ``qpos``.
    """

    def __init__(
        self,
        model: Any,
        effects: Sequence[tuple[int, ServoEffect, int]],
        goals: NDArray[np.float64],
        positions: NDArray[np.float64],
    ) -> None:
        self._effects = effects
        self._goals, self._positions = goals, positions
        joints = {actuator: actuated_joint(model, actuator) for _, _, actuator in effects}
        self._address = {a: int(model.jnt_qposadr[joint]) for a, joint in joints.items()}
        self._dof = {a: int(model.jnt_dofadr[joint]) for a, joint in joints.items()}

    def add_to(self, applied: NDArray[np.float64], tables: Tables) -> None:
        """Adds the forces in the present state.

        Args:
            applied: Generalised forces, ``(N, nv)``.
            tables: Parameters of the effects; its constants are the gains, by actuator.
        """
        for place, effect, actuator in self._effects:
            error = self._goals[:, actuator] - self._positions[:, self._address[actuator]]
            gain = tables.constants[actuator]
            force = effect.change(torch.from_numpy(error), gain, tables.effects[place])
            applied[:, self._dof[actuator]] += force.numpy()
