"""The Furuta pendulum in MuJoCo, with what the engine itself has to offer hidden inside.

Dry friction is the engine's constraint, the actuator's lag its activation dynamics, the tilt its
gravity, and a filtered velocity comes of differences of positions, as a driver makes it.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hidden_rigs.driving import commanded, references, starts
from hidden_rigs.hidden import Hidden
from hidden_rigs.measurement import Measurement, noisy
from hidden_rigs.mechanics import Array
from hidden_rigs.recording import Recording
from hidden_rigs.rig import Rig
from npdr_ppl.errors import ModelError
from npdr_ppl.models import furuta_mujoco
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

__all__ = ["record_in_mujoco"]

_XML = Path(furuta_mujoco.__file__).with_name("furuta.xml")


@dataclass(frozen=True)
class _LaggingRig(FurutaRig):
    """A rig whose actuator has activation dynamics.

    Attributes:
        actuator_time_constant: Of the engine's exact first-order filter, in s; 0 for none.
    """

    actuator_time_constant: float = 0.0

    def model(self) -> Any:
        """Returns the rig's ``mujoco.MjModel``."""
        plain = super().model()
        if self.actuator_time_constant == 0.0:
            return plain
        mujoco: Any = importlib.import_module("mujoco")
        spec = mujoco.MjSpec.from_file(str(_XML))
        actuator = spec.actuators[0]
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = self.actuator_time_constant
        model = spec.compile()
        model.opt.gravity[:] = plain.opt.gravity
        for name in ("body_mass", "body_inertia", "body_pos", "body_ipos", "dof_damping",
                     "dof_frictionloss", "dof_armature", "actuator_gainprm",
                     "actuator_biasprm"):  # fmt: skip
            getattr(model, name)[:] = getattr(plain, name)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


def record_in_mujoco(
    rig: Rig,
    excitations: Sequence[str],
    *,
    parameters: Mapping[str, float],
    hidden: Sequence[Hidden] = (),
    measurement: Measurement | None = None,
    is_from_rest: bool = False,
    seed: int,
    duration: float | None = None,
) -> Recording:
    """Records one rollout per excitation; see :func:`hidden_rigs.recording.record`.

    An episode ends early where a state leaves its bounds.

    Raises:
        ModelError: The engine has no such effect.
    """
    device = _device(parameters, hidden)
    num_steps = round((duration or rig.duration) / rig.time_step)
    wanted = references(rig, excitations, num_steps, 0, seed)
    positions, velocities = starts(rig, len(excitations), is_from_rest, seed)
    generator = np.random.default_rng(derived_seed(seed, "noise"))
    readings, actions, states = [], [], []
    for r in range(len(excitations)):

        def controller(state: Array, time: float, r: int = r) -> Array:
            reference = wanted[round(time / rig.time_step), :, r]
            return commanded(rig, reference, state[:2], state[2:])

        episode = device.run(
            controller,
            num_steps,
            initial_state=np.concatenate((positions[:, r], velocities[:, r])),
            time_step=rig.time_step,
        )
        values = episode.readings[None]
        if measurement is not None:
            values = noisy(values, measurement, generator)
        readings.append(values[0])
        actions.append(episode.voltage[:, None])
        states.append(episode.true_states)
    units = rig.units
    rollouts = Rollouts.from_arrays(
        readings,
        actions,
        channel_names=rig.layout.sensors,
        action_names=rig.layout.actions,
        time_step=rig.time_step,
        channel_units=units[0],
        action_units=units[1],
    )
    shortest = min(len(s) for s in states)
    return Recording(rollouts, np.stack([s[:shortest] for s in states]))


def _device(parameters: Mapping[str, float], hidden: Sequence[Hidden]) -> FurutaRig:
    """Returns the rig with what is hidden switched on."""
    settings: dict[str, Any] = {}
    values = dict(parameters)
    for h in hidden:
        p = h.parameters
        if h.effect_id == "coulomb_friction":
            settings[f"{h.port}_friction"] = p["magnitude"]
        elif h.effect_id == "viscous_friction":
            values[f"{h.port}_damping"] += p["damping"]
        elif h.effect_id == "input_delay":
            settings["input_delay"] = p["delay"]
        elif h.effect_id == "actuator_lag":
            settings["actuator_time_constant"] = p["time_constant"]
        elif h.effect_id == "sensor_low_pass":
            settings["velocity_time_constant"] = p["time_constant"]
        elif h.effect_id == "tilt":
            settings["tilt"] = (p["roll"], p["pitch"])
        else:
            raise ModelError(f"The rig in MuJoCo cannot hide {h.name}.")
    # The encoders' counts are the measurement's.
    return _LaggingRig(parameters=values, encoder_counts=0, **settings)
