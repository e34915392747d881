"""The rig that recordings come from: an arm behind servos, with what is hidden in it.

It is simulated by the Runge-Kutta method in finer steps than the user's file, with laws of hidden
effects that are written here a second time; none of them is one of the package's.

Euler's method is of no use here: in steps of 0.1 ms its error looks like a delay of the servos of
50 µs, 50 standard deviations of the noise in two recordings of 10 s. The Runge-Kutta method's is
0.01 in steps of 0.5 ms.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from servo_arms_links import GRAVITY, TIME_STEP, Arm, Array, Values, mjcf

from npdr_ppl.errors import DataError

__all__ = ["FIT", "HOLDOUT", "LAWS", "Hidden", "changed", "simulate"]

mujoco: Any = importlib.import_module("mujoco")

FIT, HOLDOUT = (0, 1), (2,)
"""Rollouts to fit, and held out."""

SETTLING = 1.0
"""Seconds under the first command before a recording begins."""

CREEP = 2e-3
"""Speed in rad/s below which the rig's dry friction fades, so that it is a function of speed."""


@dataclass(frozen=True)
class Hidden:
    """An effect in a rig.

    Attributes:
        kind: Its law: one of ``LAWS``, or a change of the arm, of the commands or of the readings.
        joint: Number of the joint, ``None`` for the whole arm.
        size: Its size in the law's unit; of a tilt, roll and pitch.
    """

    kind: str
    joint: int | None
    size: tuple[float, ...]

    def scaled(self, strength: float) -> "Hidden":
        """Returns the effect with a multiple of its size."""
        return replace(self, size=tuple(strength * value for value in self.size))


def simulate(
    arm: Arm, values: Values, commands: Array, hidden: Sequence[Hidden] = (), *, substeps: int = 4
) -> Array:
    """Returns the rig's readings without noise, ``(steps + 1, n)``, in rad.

    Args:
        arm: The arm.
        values: The rig's values.
        commands: Positions that the servos are to reach, ``(steps, n)``, in rad.
        hidden: Effects.
        substeps: Steps of the rig per sample.

    Raises:
        DataError: The rig is unstable.
    """
    step = TIME_STEP / substeps
    own = changed(arm, hidden)
    file = mjcf(arm, values, time_step=step, integrator="RK4", **own)
    model = mujoco.MjModel.from_xml_string(file)
    data = mujoco.MjData(model)
    data.qpos[:] = commands[0]
    settling = round(SETTLING / TIME_STEP)
    commands = np.concatenate((np.tile(commands[:1], (settling, 1)), commands))
    reached = _reached(commands, hidden)
    laws = [(LAWS[e.kind], e.joint, e.size[0]) for e in hidden if e.kind in LAWS]
    positions = []
    for sample in range(len(commands)):
        if sample >= settling:
            positions.append(data.qpos.copy())
        if not hidden:
            data.ctrl[:] = commands[sample]
            mujoco.mj_step(model, data, substeps)
            continue
        for command in reached(sample, substeps):
            data.ctrl[:] = command
            if laws:
                data.qfrc_applied[:] = 0.0
                for law, joint, size in laws:
                    data.qfrc_applied[joint] += law(data, joint, size)
            mujoco.mj_step(model, data)
    result = np.array([*positions, data.qpos])
    # MuJoCo resets a state that is not finite.
    if not np.isfinite(result).all() or any(w.number for w in data.warning):
        raise DataError("The rig is unstable.")
    return _read(result, hidden)


def changed(arm: Arm, hidden: Sequence[Hidden]) -> dict[str, Any]:
    """Returns what hidden effects change of the arm itself, as arguments of ``mjcf``."""
    result: dict[str, Any] = {}
    for effect in hidden:
        if effect.kind == "payload":
            result["payload"] = effect.size[0]
        elif effect.kind == "tool":
            result["tool"] = effect.size[0]
        elif effect.kind == "tilt":
            result["gravity"] = _tilted(*effect.size)
        elif effect.kind == "servo_gain":
            result["gains"] = np.array([link.gains[0] for link in arm.links])
            result["gains"][effect.joint] *= 1.0 + effect.size[0]
    return result


def _reached(commands: Array, hidden: Sequence[Hidden]) -> Callable[[int, int], Array]:
    """Returns what reaches the servos in a sample's steps, ``(substeps, n)``.

    A late command changes within a step: its mean in the step acts, so that no delay is rounded.
    """
    late, slow = np.zeros(commands.shape[1]), np.zeros(commands.shape[1])
    for effect in hidden:
        everywhere = slice(None) if effect.joint is None else effect.joint
        if effect.kind in ("servo_delay", "bus_delay"):
            late[everywhere] += effect.size[0]
        elif effect.kind == "lag":
            slow[everywhere] += effect.size[0]
    shifted = np.flatnonzero(late + slow)
    lagged = np.array(commands)
    for joint in np.flatnonzero(slow):
        kept = math.exp(-TIME_STEP / slow[joint])
        for sample in range(1, len(lagged)):  # the output at each sample's end
            lagged[sample, joint] += kept * (lagged[sample - 1, joint] - lagged[sample, joint])

    def at(sample: int, substeps: int) -> Array:
        if not len(shifted):
            return np.broadcast_to(commands[sample], (substeps, commands.shape[1]))
        # In samples; the integral of held commands is linear in between.
        edges = sample + np.arange(substeps + 1)[:, None] / substeps - late / TIME_STEP
        whole = np.floor(edges)
        index = np.clip(whole.astype(int), 0, len(commands) - 1)
        own = np.take_along_axis(commands, index, axis=0)
        # The mean from one edge to the next: the later command has the share after its start.
        share = np.clip((edges[1:] - whole[1:]) * substeps, 0.0, 1.0)
        reached = share * own[1:] + (1.0 - share) * own[:-1]
        for joint in np.flatnonzero(slow):
            passed = (np.arange(substeps) + 0.5) * TIME_STEP / substeps
            before = lagged[max(sample - 1, 0), joint]
            now = commands[sample, joint]
            reached[:, joint] = now + (before - now) * np.exp(-passed / slow[joint])
        return reached

    return at


def _read(positions: Array, hidden: Sequence[Hidden]) -> Array:
    """Returns what the sensors show of positions."""
    for effect in hidden:
        if effect.kind == "sensor_offset":
            positions[:, effect.joint] += effect.size[0]
    return positions


def _dry(data: Any, joint: int, size: float) -> float:
    """−F tanh(v/v₀)."""
    return -size * math.tanh(data.qvel[joint] / CREEP)


def _viscous(data: Any, joint: int, size: float) -> float:
    """−b v."""
    return -size * data.qvel[joint]


def _drag(data: Any, joint: int, size: float) -> float:
    """−c v|v|."""
    return -size * data.qvel[joint] * abs(data.qvel[joint])


def _loaded(data: Any, joint: int, size: float) -> float:
    """−μ|τ| tanh(v/v₀) with the servo's torque τ at the end of the step before."""
    return -size * abs(data.qfrc_actuator[joint]) * math.tanh(data.qvel[joint] / CREEP)


def _constant(data: Any, joint: int, size: float) -> float:
    """A constant torque."""
    return size


LAWS: dict[str, Callable[[Any, Any, float], float]] = {
    "dry_friction": _dry,
    "viscous_friction": _viscous,
    "quadratic_drag": _drag,
    "load_friction": _loaded,
    "constant_torque": _constant,
}
"""Torques on a joint, in N m, at every step of the rig."""


def _tilted(roll: float, pitch: float) -> tuple[float, float, float]:
    """Returns gravity seen from a base that is turned about x, then about y."""
    y, z = GRAVITY * math.sin(roll), -GRAVITY * math.cos(roll)
    return z * math.sin(pitch), y, z * math.cos(pitch)
