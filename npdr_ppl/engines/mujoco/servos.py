"""Servos of a MuJoCo model: actuators whose force is a gain times an error, and their effects."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from npdr_ppl.engines.mujoco.fields import servo_gains
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.language.effect_context import Servo
from npdr_ppl.language.effects import Effect, EnvironmentEffect

__all__ = ["is_servo", "with_servos"]


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
        gain = "actuator_gainprm", actuator * model.actuator_gainprm.shape[1]
        bias = "actuator_biasprm", actuator * model.actuator_biasprm.shape[1] + column
        changed = effect.environment(Servo(present(model, *gain, result)), values)
        result |= {gain: changed.gain, bias: -changed.gain}
    return result
