"""Furuta pendulums in MuJoCo as target domains: presets and random rigs."""

import re

import numpy as np
import torch

from npdr_ppl.errors import ModelError
from npdr_ppl.models.furuta import Furuta, initial_states
from npdr_ppl.models.furuta_hidden_rigs import HIDDEN, Hidden, hidden_rig
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.randomness import derived_seed
from npdr_ppl.registry import hint
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import Controller, TargetDomain, end_episode

__all__ = ["FurutaTarget", "furuta_target"]


class FurutaTarget(TargetDomain):
    """A rig that is reset to hanging, with small random offsets, before each episode.

    It runs at 500 Hz, limits the voltage to ±4 V, and ends an episode where a state leaves its
    bounds.

    Args:
        name: Name in tables and files.
        rig: The hidden rig.
    """

    sensors = Furuta.sensors
    actions = Furuta.actions
    time_step = Furuta.time_step

    def __init__(self, name: str, rig: FurutaRig) -> None:
        self.name = name
        self._rig = rig

    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Runs one episode; see :class:`TargetDomain`.

        The initial state depends on the seed alone, so that targets can be compared.
        """
        generator = torch.Generator().manual_seed(derived_seed(seed, "initial state"))
        initial_state = initial_states(1, generator)[0].double().numpy()
        recording = self._rig.run(controller, num_steps, initial_state=initial_state)
        end_episode(controller, recording.readings[-1])
        return self.rollout(recording.readings, recording.voltage[:, None])


def furuta_target(name: str) -> FurutaTarget:
    """Returns one of the rigs.

    ===========================  ===============================================================
    ``furuta-easy``              nominal, but more viscous friction; encoders, velocity filter
    ``furuta-medium``            parameters up to 8 % off; half of hard's dry friction and filter
    ``furuta-hard``              shorter arm, longer pole, 10 to 20 % off; dry friction, filter
    ``furuta-random-<seed>``     all parameters up to 25 % off, all effects; seed is a number
    ``furuta-delay-<seed>``      parameters up to 15 % off; voltage 15 to 25 ms late
    ``furuta-friction-<seed>``   parameters up to 15 % off; dry friction 3 to 5 times random's
    ``furuta-dead-zone-<seed>``  parameters up to 15 % off; amplifier's dead zone 0.3 to 0.6 V
    ===========================  ===============================================================

    Raises:
        ModelError: There is no such rig.
    """
    found = re.fullmatch(r"furuta-random-(\d+)", name)
    if found:
        return FurutaTarget(name, _random_rig(int(found.group(1))))
    found = re.fullmatch(rf"furuta-({'|'.join(HIDDEN)})-(\d+)", name)
    if found:
        kind: Hidden = found.group(1)  # pyright: ignore[reportAssignmentType]
        return FurutaTarget(name, hidden_rig(kind, int(found.group(2))))
    if name not in _PRESETS:
        known = [*_PRESETS, "furuta-random-<seed>", *(f"furuta-{kind}-<seed>" for kind in HIDDEN)]
        raise ModelError(f"There is no Furuta pendulum {name!r}; {hint(name, known)}")
    return FurutaTarget(name, _PRESETS[name])


def _scaled(factors: dict[str, float]) -> dict[str, float]:
    """Returns nominal parameters times factors."""
    nominal = {parameter.name: parameter.nominal for parameter in Furuta.parameters}
    return {name: factor * nominal[name] for name, factor in factors.items()}


# The nominal viscous friction is almost zero, at the edge of the zoo model's prior. The presets'
# friction is ten and twenty times nominal, inside the prior.
_PRESETS = {
    "furuta-easy": FurutaRig(
        parameters={"arm_damping": 5e-5, "pole_damping": 5e-6}, velocity_time_constant=0.002
    ),
    "furuta-medium": FurutaRig(
        parameters=_scaled(
            {
                "arm_length": 0.92,
                "pole_length": 1.08,
                "pole_mass": 0.94,
                "arm_mass": 1.06,
                "motor_resistance": 0.96,
                "motor_constant": 1.04,
            }
        )
        | {"arm_damping": 5e-5, "pole_damping": 5e-6},
        arm_friction=5e-4,
        pole_friction=5e-5,
        velocity_time_constant=0.002,
    ),
    # A policy made for the nominal pendulum fails with a shorter arm and a longer pole.
    "furuta-hard": FurutaRig(
        parameters=_scaled(
            {
                "arm_length": 0.8,
                "pole_length": 1.2,
                "pole_mass": 0.85,
                "arm_mass": 1.15,
                "motor_resistance": 0.9,
                "motor_constant": 1.1,
            }
        )
        | {"arm_damping": 1e-4, "pole_damping": 1e-5},
        arm_friction=1e-3,
        pole_friction=1e-4,
        velocity_time_constant=0.004,
    ),
}

# Gravity is the same for all rigs, and the dampings have their own ranges.
_NOT_SCALED = ("gravity", "arm_damping", "pole_damping")


def _random_rig(seed: int) -> FurutaRig:
    """Draws a rig; another order of the draws would change the rig of a seed."""
    generator = np.random.default_rng(seed)
    scaled = [p.name for p in Furuta.parameters if p.name not in _NOT_SCALED]
    parameters = _scaled({name: generator.uniform(0.75, 1.25) for name in scaled})
    parameters["arm_damping"] = generator.uniform(0.0, 3e-4)
    parameters["pole_damping"] = generator.uniform(0.0, 3e-5)
    return FurutaRig(
        parameters=parameters,
        arm_friction=generator.uniform(0.5e-3, 1.5e-3),
        pole_friction=generator.uniform(0.5e-4, 1.5e-4),
        velocity_time_constant=generator.uniform(2e-3, 10e-3),
    )
