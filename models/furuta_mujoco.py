"""A Furuta pendulum in another engine: a rig whose recordings no equation of ours has made."""

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import ModelError
from npdr_ppl.models.furuta import Furuta

__all__ = ["FurutaRecording", "FurutaRig"]

Array = NDArray[np.float64]

Controller = Callable[[Array, float], float]
"""Maps the four readings and the time in seconds to a voltage, before any limit."""

_XML = Path(__file__).with_name("furuta.xml")

# Lets a body be a point mass: MuJoCo wants inertias above 1e-15 kg m²; the pole's is 3e-5.
_POINT_INERTIA = 1e-10


@dataclass(frozen=True)
class FurutaRecording:
    """One episode of a rig, in SI units.

    Attributes:
        time: Time of each state, ``(K + 1,)``.
        readings: What the sensors reported: arm angle, pole angle and their rates, ``(K + 1, 4)``.
        voltage: Voltage after the limit, as recordings hold it, ``(K,)``.
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
    """A Quanser Qube in MuJoCo, with what the paper's equations leave out.

    With all effects off it follows :class:`~npdr_ppl.models.furuta.Furuta` as closely as the
    integrators allow.

    Attributes:
        parameters: Domain parameters by :class:`Furuta`'s names; missing ones are nominal.
        arm_friction: Dry friction of the arm's joint, in N m.
        pole_friction: Dry friction of the pole's joint, in N m.
        input_delay: Delay of the voltage, in s, rounded to the physics' half milliseconds.
        velocity_time_constant: Time constant of the filter that turns differences of encoder
            readings into rates, in s; 0 reports true rates.
        encoder_counts: Encoder counts per turn; 0 reports true angles.
        tilt: Roll and pitch of gravity in the base's frame, in rad; see the effect ``tilt``.
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    arm_friction: float = 0.0
    pole_friction: float = 0.0
    input_delay: float = 0.0
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
        controller: Controller,
        num_steps: int,
        *,
        initial_state: Array | None = None,
        time_step: float = Furuta.time_step,
    ) -> FurutaRecording:
        """Runs one episode; it ends early where a state leaves its bounds.

        Args:
            controller: What commands the voltage, from readings and time.
            num_steps: Greatest number of steps K.
            initial_state: Arm angle, pole angle and rates, ``(4,)``; ``None`` for hanging.
            time_step: Seconds between commands, a multiple of the physics' half millisecond.
        """
        mujoco: Any = importlib.import_module("mujoco")
        model = self.model()
        data = mujoco.MjData(model)
        start = np.zeros(4) if initial_state is None else np.asarray(initial_state, float)
        data.qpos[:], data.qvel[:] = start[:2], start[2:]
        physics_step = float(model.opt.timestep)
        num_substeps = round(time_step / physics_step)
        delay = round(self.input_delay / physics_step)
        pending = [0.0] * delay
        limit = Furuta.actions[0].upper
        bounds = np.array([state.upper for state in Furuta.states])
        true = [start]
        encoder = self._encode(start[:2])
        rates = start[2:]
        readings = [np.concatenate((encoder, rates))]
        commands: list[float] = []
        decay = 0.0
        if self.velocity_time_constant > 0.0:
            decay = math.exp(-time_step / self.velocity_time_constant)
        for step in range(num_steps):
            command = float(controller(readings[-1], step * time_step))
            commands.append(command)
            for _ in range(num_substeps):
                pending.append(min(max(command, -limit), limit))
                data.ctrl[0] = pending.pop(0)
                mujoco.mj_step(model, data)
            state = np.concatenate((data.qpos, data.qvel))
            true.append(state)
            previous, encoder = encoder, self._encode(state[:2])
            if self.velocity_time_constant > 0.0:
                difference = (encoder - previous) / time_step
                rates = difference + decay * (rates - difference)
            else:
                rates = state[2:]
            readings.append(np.concatenate((encoder, rates)))
            if np.any(np.abs(state) > bounds):
                break
        issued = np.array(commands)
        return FurutaRecording(
            time=time_step * np.arange(len(true), dtype=np.float64),
            readings=np.array(readings),
            voltage=np.clip(issued, -limit, limit),
            commands=issued,
            true_states=np.array(true),
        )

    def _encode(self, angles: Array) -> Array:
        """Returns the angles to the nearest encoder count."""
        if self.encoder_counts == 0:
            return angles.copy()
        count = 2.0 * math.pi / self.encoder_counts
        return np.round(angles / count) * count

    def _gravity(self, magnitude: float) -> list[float]:
        """Returns gravity turned by roll about x, then by pitch about y."""
        roll, pitch = self.tilt
        y, z = math.sin(roll) * magnitude, -math.cos(roll) * magnitude
        return [math.sin(pitch) * z, y, math.cos(pitch) * z]
