"""Simulations that receive the same commands pass them through action effects once."""

from dataclasses import replace

import mujoco
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ActuatorLag, GoalSpeedLimit, InputDelay
from npdr_ppl.models.pendulum import Pendulum
from tests.helpers.mujoco_files import random_inputs

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


def test_servos_with_the_same_laws_are_what_each_is_alone():
    """Two joints that do not touch each other, with the same two laws and a third at one."""
    joints = "".join(
        f'<body><joint name="{name}" armature="0.1"/><geom size="0.05" contype="0"/></body>'
        for name in "ab"
    )
    servos = "".join(f'<position name="{n}_goal" joint="{n}" kp="20" kv="2"/>' for n in "ab")
    text = f"<mujoco><worldbody>{joints}</worldbody><actuator>{servos}</actuator></mujoco>"
    plain = MujocoSimulator(mujoco.MjModel.from_xml_string(text))
    inputs = random_inputs(plain, num_steps=60)
    past = torch.randn(*inputs.actions.shape[:-2], PAST, 2, dtype=torch.float64)
    inputs = replace(inputs, past_actions=past, start=torch.full_like(inputs.start, PAST))
    lags, delay = [ActuatorLag("a_goal"), ActuatorLag("b_goal")], InputDelay("a_goal,b_goal")
    given = {
        "a_goal.actuator_lag.time_constant": torch.tensor([0.02, 0.03]).double(),
        "b_goal.actuator_lag.time_constant": torch.tensor([0.04, 0.04]).double(),
        "a_goal,b_goal.input_delay.delay": torch.tensor([0.005, 0.009]).double(),
        "b_goal.goal_speed_limit.limit": torch.tensor([3.0, 2.0]).double(),
        "b_goal.input_delay.delay": torch.tensor([0.005, 0.009]).double(),
    }

    def moved(*effects):
        simulator = plain.with_effects(*effects)
        names = [name for effect in effects for name in effect.parameter_names]
        return simulator.simulate({name: given[name] for name in names}, inputs)

    limit = GoalSpeedLimit("b_goal")
    both = moved(*lags, delay)
    torch.testing.assert_close(both[..., 0], moved(*lags, delay, limit)[..., 0])
    alone = moved(lags[1], InputDelay("b_goal"))
    torch.testing.assert_close(both[..., 1], alone[..., 1], rtol=1e-12, atol=1e-14)
    assert not torch.allclose(both[..., 0], both[..., 1])
