"""The positioning drive against its closed-form step response."""

import pyro
import pytest
import torch

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import Bias, CoulombFriction
from npdr_ppl.models.emps import Emps, emps


def step_inputs(voltage, num_steps=500):
    return Inputs.single(
        torch.full((num_steps, 1), voltage, dtype=torch.float64),
        torch.zeros(2),
        action_names=("voltage",),
        state_names=("position", "velocity"),
        time_step=0.001,
    )


@pytest.mark.parametrize("friction", [0.0, 20.4])
def test_step_response(friction):
    """v = (F/F_v)(1 − exp(−F_v t/M)) with the net force F = K u − F_c + offset."""
    simulator = Emps(integrator="rk4").with_effects(CoulombFriction("carriage"), Bias("carriage"))
    parameters = {
        "carriage.coulomb_friction.magnitude": torch.tensor(friction, dtype=torch.float64),
        "carriage.bias.offset": torch.tensor(3.2, dtype=torch.float64),
    }
    readings = simulator.simulate(parameters, step_inputs(2.0))[0]
    time = 0.001 * torch.arange(1, 501, dtype=torch.float64)
    force = 35.15065 * 2.0 - friction + 3.2
    rate = 203.5 / 95.1
    speed = force / 203.5 * (1.0 - (-rate * time).exp())
    torch.testing.assert_close(readings[:, 1], speed)
    torch.testing.assert_close(readings[:, 0], (force / 203.5) * time - speed / rate)


def test_friction_holds_a_weak_voltage():
    simulator = Emps().with_effects(CoulombFriction("carriage"))
    parameters = {"carriage.coulomb_friction.magnitude": torch.tensor(20.4, dtype=torch.float64)}
    assert (simulator.simulate(parameters, step_inputs(0.5)) == 0.0).all()


def test_model_samples_mass_and_friction():
    with pyro.poutine.trace() as tracer, pyro.plate("draws", 3), torch.no_grad():
        trajectory = emps(step_inputs(1.0, 20))
    assert trajectory.shape == (3, 1, 20, 2)
    assert {"mass", "viscous_friction"} < set(tracer.trace.nodes)
    assert "drive_gain" not in tracer.trace.nodes
