"""Steps MuJoCo with laws, in the order in which npdr_ppl's own simulations apply them."""

# pyright: reportAttributeAccessIssue=false
import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from npdr_ppl.engines.mujoco.callbacks.command_laws import CommandLaw, ServoLaw
from npdr_ppl.engines.mujoco.callbacks.joint_laws import Joint, JointLaw, JointPlace
from npdr_ppl.engines.mujoco.callbacks.sensor_laws import SensorLaw

__all__ = ["Channel", "LawRunner"]

Channel = tuple[str, str | int, int]
"""Where a measurement is: ``"qpos"`` and a joint, ``"qvel"`` and a joint, or ``"sensordata"`` and
a sensor; then the number of the component in it."""


class Axis:
    """The degree of freedom of a joint on which a law acts.

    Args:
        model: The ``mujoco.MjModel``.
        place: The joint, or the joint and the number of its degree of freedom.
    """

    def __init__(self, model: Any, place: JointPlace) -> None:
        name, number = place if isinstance(place, tuple) else (place, None)
        joint = model.joint(name)
        first, self.place = int(joint.dofadr[0]), int(joint.qposadr[0])
        is_free = int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)
        # MuJoCo has the velocity of a free joint in the world's frame, its spin in the body's.
        self.along = number if number is not None and is_free and number < 3 else None
        self.is_floating = number is not None
        self.dofs = (
            [first, first + 1, first + 2] if self.along is not None else [first + (number or 0)]
        )

    def _direction(self, data: Any) -> Any:
        """Returns the body's axis in the world's frame; 1 for other joints."""
        if self.along is None:
            return np.ones(1)
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, data.qpos[self.place + 3 : self.place + 7])
        return matrix.reshape(3, 3)[:, self.along]

    def position(self, data: Any) -> float:
        """Returns the joint's position; NaN for a body that floats."""
        return math.nan if self.is_floating else float(data.qpos[self.place])

    def velocity(self, data: Any) -> float:
        """Returns the velocity along the axis or about it."""
        return float(self._direction(data) @ data.qvel[self.dofs])

    def apply(self, data: Any, force: float) -> None:
        """Adds a force along the axis or about it."""
        data.qfrc_applied[self.dofs] += self._direction(data) * force


class LawRunner:
    """Passes the commands, forces and measurements of one simulation through laws.

    Args:
        model: The ``mujoco.MjModel``. Its own clipping of commands is switched off: commands are
            clipped before the laws. ``qfrc_applied`` at the joints of laws belongs to them.
        laws: The laws, in the order in which they act.
        channels: Where each measurement is.
        substeps: Engine steps per control step.
    """

    def __init__(
        self,
        model: Any,
        laws: Sequence[JointLaw | CommandLaw | ServoLaw | SensorLaw],
        channels: Mapping[str, Channel],
        substeps: int,
    ) -> None:
        self.model, self.substeps = model, substeps
        self.forces = [(law, Axis(model, law.joint)) for law in laws if isinstance(law, JointLaw)]
        self.dofs = sorted({dof for _, axis in self.forces for dof in axis.dofs})
        self.commands = [
            (law, model.actuator(law.actuator).id) for law in laws if isinstance(law, CommandLaw)
        ]
        self.servos = [
            (law, model.actuator(law.actuator).id) for law in laws if isinstance(law, ServoLaw)
        ]
        self.sensors = [law for law in laws if isinstance(law, SensorLaw)]
        self.channels = {name: self._address(*place) for name, place in channels.items()}
        self.rates = {name for name, place in channels.items() if place[0] == "qvel"}
        self.partners = _partners(model, channels)
        self.last: dict[str, float] = {}
        self.previous: dict[str, float] = {}
        bending = [law.channel if law.takes_bend else None for law in self.sensors]
        self.later = {
            k for k, name in enumerate(bending) if name is not None and name in bending[:k]
        }
        self.inputs: dict[int, tuple[float, float]] = {}
        self.needs_dynamics = any(law.needs_dynamics for law, _ in self.forces)
        self.friction = model.dof_frictionloss
        low, high = model.actuator_ctrlrange.T
        self.low = np.where(model.actuator_ctrllimited, low, -np.inf)
        self.high = np.where(model.actuator_ctrllimited, high, np.inf)
        self.is_started = False
        self.before: Any = None
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)

    def reset(self, data: Any, commands_before: Any = None) -> dict[str, float]:
        """Starts a rollout in the present state of the data; returns the first measurements.

        The robot is taken to have rested before. Drifts and waves begin at ``data.time`` 0.

        Args:
            data: The ``mujoco.MjData``.
            commands_before: The commands that were held before, one per actuator, such as those
                that keep a drone in the air. By default, servos were at their first goal and
                other commands at zero.
        """
        self.is_started = False
        self.before = None if commands_before is None else np.array(commands_before, dtype=float)
        data.qfrc_applied[self.dofs] = 0.0
        for law, axis in self.forces:
            law.reset(axis.velocity(data))
        for law, _ in self.servos:
            law.reset()
        values = self._true_values(data)
        self.last, self.previous = dict(values), dict.fromkeys(values, math.nan)
        self.inputs = dict.fromkeys(self.later, (math.nan, math.nan))
        step = self.substeps * float(self.model.opt.timestep)
        for law in self.sensors:
            values[law.channel] = law.reset(values[law.channel], step)
        return values

    def step(self, data: Any, commands: Any, substeps: int | None = None) -> dict[str, float]:
        """Advances the data by one control step; returns the measurements after it.

        Args:
            data: The ``mujoco.MjData``.
            commands: One per actuator, shape ``(nu,)``.
            substeps: Engine steps per control step, if it differs from the recording's; the same
                during a rollout.
        """
        count = substeps or self.substeps
        step = count * float(self.model.opt.timestep)
        means, moments = self._after_laws(np.array(commands, dtype=float), step)
        # A command that changes within the step is replaced by a straight line.
        slope = 12.0 / (step * step * count)
        for k in range(count):
            data.ctrl[:] = means + slope * moments * (k - 0.5 * (count - 1))
            self._substep(data)
        true = self._true_values(data)
        values = dict(true)
        for k, law in enumerate(self.sensors):
            name, bend = law.channel, 0.0
            if k in self.inputs and values[name] != true[name]:
                # The bend of a true value is not that of a late or filtered one.
                last, previous = self.inputs[k]
                bend = self._bend_of_three(name, values[name], last, previous)
            elif law.takes_bend and self.last:
                bend = self._bend(name, true, step, count)
            if k in self.inputs:
                self.inputs[k] = values[name], self.inputs[k][0]
            values[name] = law.read(values[name], bend, float(data.time), step)
        self.last, self.previous = true, self.last
        return values

    @property
    def is_fourth(self) -> bool:
        """Whether the integrator is RK4."""
        return bool(self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4)

    def _bend(self, name: str, true: Mapping[str, float], step: float, count: int) -> float:
        """Returns how a channel deviated from a straight line in the last step."""
        last, partner = self.last, self.partners.get(name)
        change = true[name] - last[name]
        if name not in self.rates:
            if partner is None:
                return self._bend_of_three(name, true[name], last[name], self.previous[name])
            return 0.5 * step * (last[partner] - true[partner])
        if partner is None:
            return 0.0
        # RK4 advances positions with a mean velocity; all other integrators use the velocity at
        # the end of an engine step.
        lag = 0.0 if self.is_fourth else 0.5 / count
        mean = last[name] + (0.5 + lag) * change
        return 6.0 * ((true[partner] - last[partner]) / step - mean)

    def _bend_of_three(self, name: str, present: float, last: float, previous: float) -> float:
        """Returns the bend of the parabola through three values; 0 if one of them is unknown."""
        if name in self.rates or math.isnan(previous):
            return 0.0
        return 0.5 * (2.0 * last - previous - present)

    def _after_laws(self, commands: Any, step: float) -> tuple[Any, Any]:
        """Returns mean and moment of each command after the laws, for a step in seconds."""
        commands = np.minimum(np.maximum(commands, self.low), self.high)
        if not self.is_started:
            model = self.model
            # A servo has held its first goal; other commands were zero.
            gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
            is_goal = (gain != 0.0) & ((bias[:, 1] == -gain) | (bias[:, 2] == -gain))
            before = np.where(is_goal, commands, 0.0) if self.before is None else self.before
            before = np.minimum(np.maximum(before, self.low), self.high)
            for law, i in self.commands:
                before[i] = law.settle(float(before[i]), step)
            self.is_started = True
        moments = np.zeros_like(commands)
        for law, i in self.commands:
            commands[i], moment = law.act(float(commands[i]), step)
            moments[i] += moment
        return commands, moments

    def _substep(self, data: Any) -> None:
        """Advances the data by one engine step."""
        model = self.model
        means: dict[int, float] = {}
        for law, i in self.servos:
            joint, step = model.actuator_trnid[i, 0], float(model.opt.timestep)
            position = float(data.qpos[model.jnt_qposadr[joint]])
            error = float(data.ctrl[i]) - position
            mean = means.get(i, error - 0.5 * step * float(data.qvel[model.jnt_dofadr[joint]]))
            acted, means[i] = law.act(error, mean, step)
            # RK4 follows the error within the step; all other integrators hold the servo's force.
            change = means[i] - mean if self.is_fourth else acted - error
            data.ctrl[i] += change
        h, middle = model.opt.timestep, data.time + 0.5 * model.opt.timestep
        joints = [
            Joint(axis.position(data), axis.velocity(data), middle, h) for _, axis in self.forces
        ]
        if self.needs_dynamics:
            self._add_dynamics(joints, data)
        own_friction = [(dof, self.friction[dof]) for dof in self.dofs]
        data.qfrc_applied[self.dofs] = 0.0
        for (law, axis), joint in zip(self.forces, joints, strict=True):
            axis.apply(data, law.applied_force(joint))
            self.friction[axis.dofs] += law.dry_friction(joint)
            law.finish(joint)
        mujoco.mj_step(model, data)
        for dof, bound in own_friction:
            self.friction[dof] = bound

    def _add_dynamics(self, joints: list[Joint], data: Any) -> None:
        """Gives the joints what laws need that solve for their own force, and advances them."""
        model = self.model
        data.qfrc_applied[self.dofs] = 0.0
        for (law, axis), joint in zip(self.forces, joints, strict=True):
            if not law.needs_dynamics:
                axis.apply(data, law.applied_force(joint))
        guess = data.qacc_warmstart.copy()
        mujoco.mj_forward(model, data)
        data.qacc_warmstart[:] = guess
        for (law, axis), joint in zip(self.forces, joints, strict=True):
            if law.needs_dynamics:
                (dof,) = axis.dofs
                unit, reached = np.zeros((1, model.nv)), np.zeros((1, model.nv))
                unit[0, dof] = 1.0
                mujoco.mj_solveM(model, data, reached, unit)
                joint.acceleration = float(data.qacc[dof])
                joint.inverse_inertia = float(reached[0, dof])
                joint.drive = float(data.qfrc_actuator[dof])
                law.begin(joint)

    def _address(self, array: str, element: str | int, component: int) -> tuple[str, int]:
        """Returns an array of the data and a place in it."""
        if array == "sensordata":
            return array, int(self.model.sensor(element).adr[0]) + component
        joint = self.model.joint(element)
        first = joint.qposadr if array == "qpos" else joint.dofadr
        return array, int(first[0]) + component

    def _true_values(self, data: Any) -> dict[str, float]:
        """Returns the true value of every channel.

        Sensors of positions and velocities are computed again, because a step leaves those of its
        start. Sensors of accelerations keep the values of the last engine step.
        """
        if any(array == "sensordata" for array, _ in self.channels.values()):
            mujoco.mj_fwdPosition(self.model, data)
            mujoco.mj_sensorPos(self.model, data)
            mujoco.mj_fwdVelocity(self.model, data)
            mujoco.mj_sensorVel(self.model, data)
        return {name: float(getattr(data, a)[i]) for name, (a, i) in self.channels.items()}


def _partners(model: Any, channels: Mapping[str, Channel]) -> dict[str, str]:
    """Returns the rate of each position among the channels, and the position of each rate."""
    kinds = mujoco.mjtJoint
    names = {place: name for name, place in channels.items()}
    result = {}
    for (array, joint, component), name in names.items():
        rate = names.get(("qvel", joint, component))
        if array != "qpos" or rate is None:
            continue
        kind = int(model.joint(joint).type[0])
        # Of a free joint, only the first three components of the velocity are rates.
        is_scalar = kind in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE))
        if is_scalar or (kind == int(kinds.mjJNT_FREE) and component < 3):
            result |= {name: rate, rate: name}
    return result
