"""A recording of a pendulum with dry friction, which the zoo's model has not."""

import math

import torch

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects.friction import CoulombFriction
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.rollouts import Rollouts

FRICTION = 0.35
"""Newton metres, of 4.5 that the motor has."""

MISSING = "hinge.coulomb_friction"

CANDIDATES = "hinge.coulomb_friction,torque.actuator_gain,hinge.bias"
"""Few, so that a search takes seconds."""


def pendulum_recording(num_rollouts=4, num_steps=250):
    """Returns noisy rollouts under sums of two sines; the last has other frequencies."""
    step = Pendulum.time_step
    time = step * torch.arange(num_steps, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    rig = Pendulum().with_effects(CoulombFriction("hinge"))
    truth = {"mass": 0.9, "length": 1.1, f"{MISSING}.magnitude": FRICTION}
    parameters = {name: torch.tensor(value).double() for name, value in truth.items()}
    readings, actions = [], []
    for k in range(num_rollouts):
        slow, fast = 2 * math.pi * (0.4 + 0.15 * k), 2 * math.pi * (1.1 + 0.1 * k)
        torque = (2.0 * torch.sin(slow * time) + 1.5 * torch.sin(fast * time + k))[:, None]
        start = torch.tensor([0.3 * k - 0.4, 0.0], dtype=torch.float64)
        inputs = Inputs.single(
            torque, start, action_names=("torque",), state_names=("angle", "velocity"),
            time_step=step,
        )  # fmt: skip
        exact = torch.cat([start[None], rig.simulate(parameters, inputs).reshape(-1, 2)])
        noise = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        readings.append((exact + torch.tensor([0.002, 0.02]) * noise).numpy())
        actions.append(torque.numpy())
    return Rollouts.from_arrays(
        readings=readings, actions=actions, channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=step,
    )  # fmt: skip
