"""Policies whose own model is the same in every domain, as on a device that nobody knows."""

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.models.furuta import Furuta, SwingUpReward
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.base import Policy, PolicyParameter
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from tests.helpers.bullet_models import bullet_pendulum, pendulum_urdf
from tests.helpers.mujoco_files import furuta_in_mujoco

STATES = torch.tensor([[0.0, 0.1, 0.0, 0.0], [0.02, -0.05, 0.0, 0.1]], dtype=torch.float64)
LENGTHS = torch.tensor([[0.11], [0.14], [0.16]], dtype=torch.float64)
BELIEVED = {"pole_length": 0.125, "arm_mass": 0.1}


@pytest.mark.slow
@pytest.mark.parametrize(
    "simulator",
    [Furuta(compile="never"), Furuta(compile="always"), furuta_in_mujoco(substeps=2)],
    ids=["equations", "compiled", "mujoco"],
)
def test_the_policy_takes_every_domain_for_its_own_model(simulator):
    options = {"num_steps": 60, "reward": SwingUpReward()}
    domains = {"pole_length": LENGTHS}
    own = simulator.roll_out(domains, FurutaSwingUp(), STATES, **options)
    found = simulator.roll_out(
        domains, FurutaSwingUp(), STATES, internal_model=BELIEVED, **options
    )
    # The policy has had such an argument of its own all along.
    expected = simulator.roll_out(
        domains, FurutaSwingUp(internal_model=BELIEVED), STATES, **options
    )
    torch.testing.assert_close(found.returns, expected.returns)
    assert not torch.allclose(found.returns, own.returns, rtol=1e-6)


class ByMass(Policy):
    """Commands a torque in proportion to the mass of its own model."""

    observations = ()
    actions = ("torque",)
    parameter_info = (PolicyParameter("gain", 1.0),)

    def constants(self, domain):
        return domain["mass"] * self.parameters[..., 0]

    def act(self, observation, time, memory, constants):
        return (constants,), memory


@pytest.mark.slow
def test_simulators_on_workers_take_it_too(tmp_path):
    masses = torch.tensor([0.2, 0.4], dtype=torch.float64)
    start = torch.tensor([0.5, 0.0], dtype=torch.float64)
    options = {"num_steps": 5, "record": True}
    simulators = [bullet_pendulum(pendulum_urdf(tmp_path)), Pendulum(compile="never")]
    with npdr.workers("serial"):
        for simulator in simulators:
            domains = {"mass": masses}
            own = simulator.roll_out(domains, ByMass(), start, **options)
            found = simulator.roll_out(
                domains, ByMass(), start, internal_model={"mass": 0.3}, **options
            )
            middle = 0.5 * (own.commands[0, 0] + own.commands[1, 0])
            torch.testing.assert_close(found.commands, middle.expand_as(found.commands))
