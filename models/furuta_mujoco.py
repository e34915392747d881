"""A Furuta pendulum in MuJoCo: its recordings do not come from our own equations of motion."""

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.targets.base import TargetError

__all__ = ["FurutaRecording", "FurutaRig"]

Array = NDArray[np.float64]

VoltageController = Callable[[Array, float], float | Array]
"""Maps the four measurements and the time in seconds to a voltage, before any limit."""

_XML = Path(__file__).with_name("furuta.xml")

# For point masses: MuJoCo requires inertias above 1e-15 kg m²; the pole's is 3e-5 kg m².
_POINT_INERTIA = 1e-10


@dataclass(frozen=True)
class FurutaRecording:
    """One episode of a rig, in SI units.

    Attributes:
        time: Time of each state, ``(K + 1,)``.
        readings: Measured arm angle, pole angle and their rates, ``(K + 1, 4)``.
        voltage: Voltage after the limit, as stored in recordings, ``(K,)``.
        commands: Voltage before the limit, ``(K,)``.
        true_states: Positions and rates of the bodies, ``(K + 1, 4)``.
    """

    time: Array
    readings: Array
    voltage: Array
    commands: Array
    true_states: Array


@dataclass(frozen=True)
class FurutaRig:
    """A Quanser Qube in MuJoCo, with effects that the paper's equations leave out.

    With all effects off it equals :class:`~npdr_ppl.models.furuta.Furuta` up to the error of the
    integrators.

    Attributes:
        parameters: Domain parameters by :class:`Furuta`'s names; missing ones are nominal.
        arm_friction: Dry friction of the arm's joint, in N m.
        pole_friction: Dry friction of the pole's joint, in N m.
        input_delay: Delay of the voltage, in s, rounded to multiples of the 0.5 ms physics step.
        voltage_dead_zone: Half width δ of the amplifier's dead zone, in V: its output is sign(u)
            max(|u| − δ, 0), while recordings contain u.
        velocity_time_constant: Time constant, in s, of the filter that computes rates from
            differences of encoder angles; 0 reports true rates.
        encoder_counts: Encoder resolution in steps per turn; 0 reports true angles.
        tilt: Roll and pitch of gravity in the base's frame, in rad; see the effect ``tilt``.
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    arm_friction: float = 0.0
    pole_friction: float = 0.0
    input_delay: float = 0.0
    voltage_dead_zone: float = 0.0
    velocity_time_constant: float = 0.0
    encoder_counts: int = 2048
    tilt: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Checks the parameters' names."""
        known = {parameter.name for parameter in Furuta.parameters}
        unknown = sorted(set(self.parameters) - known)
        if unknown:
            raise ModelError(
                f"The Furuta rig has no parameter {', '.join(unknown)}; it has "
                f"{', '.join(sorted(known))}."
            )

    def model(self) -> Any:
        """Returns the rig's ``mujoco.MjModel``."""
        mujoco: Any = importlib.import_module("mujoco")

        p = {parameter.name: parameter.nominal for parameter in Furuta.parameters}
        p |= {name: float(value) for name, value in self.parameters.items()}
        model = mujoco.MjModel.from_xml_path(str(_XML))
        model.opt.gravity[:] = self._gravity(p["gravity"])
        arm, pole = model.body("arm").id, model.body("pole").id
        arm_inertia = p["arm_mass"] * p["arm_length"] ** 2 / 12.0
        model.body_mass[[arm, pole]] = p["arm_mass"], p["pole_mass"]
        model.body_inertia[arm] = _POINT_INERTIA, arm_inertia, arm_inertia
        model.body_pos[pole] = p["arm_length"], 0.0, 0.0
        model.body_ipos[pole] = 0.0, 0.0, -0.5 * p["pole_length"]
        model.dof_damping[:] = p["arm_damping"], p["pole_damping"]
        model.dof_frictionloss[:] = self.arm_friction, self.pole_friction
        model.dof_armature[1] = p["pole_mass"] * p["pole_length"] ** 2 / 12.0
        gain = p["motor_constant"] / p["motor_resistance"]
        model.actuator_gainprm[0, 0] = gain
        model.actuator_biasprm[0, 2] = -gain * p["motor_constant"]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def run(
        self,
        controller: VoltageController,
        num_steps: int,
        *,
        initial_state: Array | None = None,
        time_step: float = Furuta.time_step,
    ) -> FurutaRecording:
        """Runs one episode; it ends early where a state leaves its bounds.

        Args:
            controller: Returns the voltage, a number or an array ``(1,)``.
            num_steps: Maximum number of steps K.
            initial_state: Arm angle, pole angle and rates, ``(4,)``; ``None`` for hanging.
            time_step: Seconds between commands, a multiple of the physics step of 0.5 ms.
        """
        mujoco: Any = importlib.import_module("mujoco")
        model = self.model()
        data = mujoco.MjData(model)
        start = np.zeros(4) if initial_state is None else np.asarray(initial_state, float)
        data.qpos[:], data.qvel[:] = start[:2], start[2:]
        position, velocity = data.qpos, data.qvel  # views that stay valid for the whole episode
        physics_step = float(model.opt.timestep)
        num_substeps = round(time_step / physics_step)
        # The delay of a voltage is a number of whole steps plus a number of substeps.
        whole, late = divmod(round(self.input_delay / physics_step), num_substeps)
        voltages = [0.0] * (whole + 1)
        limit, dead_zone = Furuta.actions[0].upper, self.voltage_dead_zone
        bounds = [state.upper for state in Furuta.states]
        count = 2.0 * math.pi / self.encoder_counts if self.encoder_counts else 0.0
        decay = 0.0
        if self.velocity_time_constant > 0.0:
            decay = math.exp(-time_step / self.velocity_time_constant)
        state = start.tolist()
        true = [state]
        angles, rates = _encoded(state[:2], count), state[2:]
        readings = [angles + rates]
        commands: list[float] = []
        # For four numbers, floats are faster than arrays.
        for step in range(num_steps):
            command = _voltage(controller(np.array(readings[-1]), step * time_step))
            commands.append(command)
            limited = min(max(command, -limit), limit)
            voltages.append(math.copysign(max(abs(limited) - dead_zone, 0.0), limited))
            if late:
                data.ctrl[0] = voltages[step]
                mujoco.mj_step(model, data, nstep=late)
            data.ctrl[0] = voltages[step + 1]
            mujoco.mj_step(model, data, nstep=num_substeps - late)
            state = position.tolist() + velocity.tolist()
            true.append(state)
            previous, angles = angles, _encoded(state[:2], count)
            if self.velocity_time_constant > 0.0:
                slopes = [
                    (new - old) / time_step for new, old in zip(angles, previous, strict=True)
                ]
                rates = [s + decay * (r - s) for s, r in zip(slopes, rates, strict=True)]
            else:
                rates = state[2:]
            readings.append(angles + rates)
            # Written so that a NaN counts as outside.
            if not all(abs(x) <= bound for x, bound in zip(state, bounds, strict=True)):
                break
        issued = np.array(commands)
        return FurutaRecording(
            time=time_step * np.arange(len(true), dtype=np.float64),
            readings=np.array(readings),
            voltage=np.clip(issued, -limit, limit),
            commands=issued,
            true_states=np.array(true),
        )

    def _gravity(self, magnitude: float) -> list[float]:
        """Returns gravity turned by roll about x, then by pitch about y."""
        roll, pitch = self.tilt
        y, z = math.sin(roll) * magnitude, -math.cos(roll) * magnitude
        return [math.sin(pitch) * z, y, math.cos(pitch) * z]


def _encoded(angles: list[float], count: float) -> list[float]:
    """Returns angles rounded to the encoder resolution in rad; 0 leaves them unchanged."""
    return [round(angle / count) * count for angle in angles] if count else angles


def _voltage(command: float | Array) -> float:
    """Returns a controller's command as a number.

    Raises:
        ShapeError: It is not one number.
        TargetError: It is not finite.
    """
    values = np.asarray(command, dtype=np.float64)
    if values.size != 1:
        raise ShapeError(f"The rig takes one voltage, but the controller gave {values.shape=}.")
    voltage = values.item()
    if not math.isfinite(voltage):
        raise TargetError(f"The controller commanded {voltage} V.")
    return voltage
