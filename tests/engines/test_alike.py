"""Simulations that receive the same commands pass them through action effects once."""

from dataclasses import replace

import pytest
import torch

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ActuatorLag
from npdr_ppl.models.pendulum import Pendulum

PAST = 80


def moved(time_constant):
    """Returns angles and velocities after a step behind a lag that began long before."""
    inputs = Inputs.single(
        torch.ones(1, 1, dtype=torch.float64),
        torch.tensor([0.5, 1.0], dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=Pendulum.time_step,
    )
    past = torch.sin(torch.arange(float(PAST), dtype=torch.float64))[None, :, None]
    inputs = replace(inputs, past_actions=past, start=torch.full_like(inputs.start, PAST))
    simulator = Pendulum().with_effects(ActuatorLag("torque"))
    return simulator.simulate({"torque.actuator_lag.time_constant": time_constant}, inputs)[:, 0]


def test_results_are_those_of_each_simulation_alone():
    constants = torch.tensor([0.03, 0.02, 0.03, 0.02]).double()
    together = moved(constants)
    alone = torch.cat([moved(constant[None]) for constant in constants])
    assert not torch.equal(together[0], together[1])
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=1e-14)


def test_equal_parameters_have_gradients_of_their_own():
    constants = torch.tensor([0.02, 0.02, 0.03]).double().requires_grad_()
    (gradient,) = torch.autograd.grad(moved(constants)[1, 0].sum(), constants)
    assert gradient[1].abs() > 0.0
    assert gradient[[0, 2]].tolist() == pytest.approx([0.0, 0.0])
