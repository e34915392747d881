"""Model-predictive path integral control on the pendulums, whose models it is given."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from npdr_ppl.engines.common.compilation import has_compiler
from npdr_ppl.errors import ModelError, NpdrError
from npdr_ppl.models.effects import InputDelay
from npdr_ppl.models.furuta import Furuta, SwingUpReward
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.mppi import MPPI
from npdr_ppl.policies.playback import Playback


def upright(positions, velocities, commands):
    return torch.cos(positions[0] - math.pi) - 0.01 * velocities[0].square()


def pendulum_policy(simulator=None, **options):
    options = {
        "horizon": 20,
        "num_samples": 32,
        "temperature": 0.5,
        "noise": [2.0],
        "num_knots": 6,
        "time_step": 0.04,
        **options,
    }
    return MPPI(simulator or Pendulum(), options.pop("reward", upright), **options)


def furuta_policy(simulator=None, **options):
    return MPPI(
        simulator or Furuta(integrator="rk4"),
        SwingUpReward(),
        horizon=40,
        num_samples=96,
        temperature=0.3,
        noise=[1.5],
        num_knots=10,
        time_step=0.01,
        **options,
    )


def draws(num_draws, spread=0.1):
    generator = torch.Generator().manual_seed(4)
    noise = 1.0 + spread * torch.randn(2, num_draws, generator=generator)
    return {"mass": noise[0], "length": noise[1]}


@pytest.mark.slow
def test_furuta_is_kept_upright():
    start = torch.tensor([0.1, math.pi - 0.15, 0.0, 0.0])
    out = Furuta().roll_out({}, furuta_policy(), start, 500, reward=SwingUpReward(), record=True)
    assert int(out.lengths) == 500
    assert (out.readings[100:, 1] - math.pi).abs().max() < math.radians(20.0)
    idle = Playback(torch.zeros(1, 1), ("voltage",), 0.002)
    fallen = Furuta().roll_out({}, idle, start, 200, record=True)
    assert (fallen.readings[:, 1] - math.pi).abs().max() > math.radians(90.0)


@pytest.mark.slow
def test_pendulum_swings_up_though_too_weak_to_lift():
    # The hinge holds 4.9 N m at most, the motor gives half.
    class Weak(Pendulum):
        actions = (replace(Pendulum.actions[0], lower=-2.5, upper=2.5),)

    policy = pendulum_policy(Weak(), horizon=40, num_samples=64, num_knots=8)
    out = Weak().roll_out({}, policy, torch.zeros(2), 300, record=True)
    assert (torch.cos(out.readings[-50:, 0]) < -0.95).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("domains", [{}, draws(3)], ids=["own domain", "draws"])
def test_batch_equals_a_loop(dtype, domains):
    policy = pendulum_policy(domains=domains, replan_every=2)
    masses = torch.tensor([[0.7], [1.2]], dtype=dtype)
    states = torch.tensor([[0.0, 0.0], [1.0, -0.5]], dtype=dtype)
    out = Pendulum().roll_out({"mass": masses}, policy, states, 12, record=True)
    assert out.commands.shape == (2, 2, 12, 1)
    assert out.commands.dtype == dtype
    for i, j in [(0, 0), (1, 0), (1, 1)]:
        one = Pendulum().roll_out({"mass": masses[i, 0]}, policy, states[j], 12, record=True)
        torch.testing.assert_close(out.commands[i, j], one.commands)


def test_device_follows_the_seed():
    readings = np.random.default_rng(0).normal(size=(8, 2))

    def commands(seed):
        control = pendulum_policy(domains=draws(2), seed=seed).controller({})
        return np.array([control(row, 0.02 * k) for k, row in enumerate(readings)])

    assert commands(1).shape == (8, 1)
    np.testing.assert_array_equal(commands(1), commands(1))
    assert (commands(1) != commands(2)).any()


def test_plan_is_executed_between_replans():
    control = pendulum_policy(replan_every=3).controller({})
    # Two device steps per step of the plan, three of these per plan.
    plans = [control(np.array([0.1 * k, 0.0]), 0.02 * k).item() for k in range(12)]
    assert plans[0] == plans[1] and plans[2] == plans[3] and plans[4] == plans[5]
    blind = pendulum_policy(replan_every=3).controller({})
    seen = [blind(np.zeros(2) if k < 6 else np.ones(2), 0.02 * k).item() for k in range(12)]
    assert seen[:6] == plans[:6]
    assert seen[6] != plans[6]


def test_commands_keep_the_limits():
    policy = pendulum_policy(noise=[50.0])
    out = Pendulum().roll_out({}, policy, torch.zeros(2), 20, record=True)
    assert out.commands.abs().max() <= 4.5


@pytest.mark.parametrize("num_knots", [2, 7, 20, None])
def test_noise_has_the_same_size_at_every_step(num_knots):
    policy = pendulum_policy(num_samples=4000, noise=[0.2], num_knots=num_knots)
    candidates = policy._candidates(torch.zeros(1, 20, 1, dtype=torch.float64), 0)
    assert (candidates[:, 0] == 0.0).all()
    # Five standard errors of a standard deviation, 1/√(2 K) of it each, at 20 steps.
    deviation = candidates[0, 1:, :, 0].std(dim=0)
    torch.testing.assert_close(
        deviation, torch.full_like(deviation, 0.2), rtol=5.0 / math.sqrt(8000.0), atol=0.0
    )


def test_returns_are_averaged_over_draws():
    states = torch.tensor([[0.3, 0.0]])
    domains = draws(3)
    policy = pendulum_policy(domains=domains)
    past = torch.zeros(1, 20, 1)
    candidates = policy._candidates(past, 0)
    together = policy._returns(candidates, past, states, {})
    single = [
        pendulum_policy(domains={name: x[m] for name, x in domains.items()})._returns(
            candidates, past, states, {}
        )
        for m in range(3)
    ]
    assert together.shape == (1, 32)
    torch.testing.assert_close(together, torch.stack(single).mean(dim=0))


def test_leaving_the_bounds_never_pays():
    """A reward below zero must not make an early end attractive."""

    class Fenced(Pendulum):
        states = (replace(Pendulum.states[0], lower=-0.5, upper=0.5), Pendulum.states[1])
        sensors = states

    def reward(positions, velocities, commands):
        return -1.0 - positions[0].square()

    policy = pendulum_policy(Fenced(), reward=reward, noise=[4.0])
    out = Fenced().roll_out({}, policy, torch.tensor([0.4, 1.0]), 100, record=True)
    assert int(out.lengths) == 100


def test_internal_model_knows_the_commands_on_their_way():
    """Under a delay of four plan steps, the first four commands of a plan come after the past."""
    simulator = Pendulum().with_effects(InputDelay("torque"))
    delay = {"torque.input_delay.delay": torch.tensor(0.16)}
    policy = pendulum_policy(simulator, domains=delay, reward=lambda q, v, u: q[0])
    states, zeros = torch.zeros(1, 2), torch.zeros(1, 20, 1)
    candidates = torch.zeros(1, 32, 20, 1)
    resting = policy._returns(candidates, zeros, states, {})
    pushed = policy._returns(candidates, zeros + 2.0, states, {})
    assert (resting == 0.0).all()
    assert (pushed > 0.1).all()


@pytest.mark.slow
def test_a_delay_is_overcome_by_a_model_that_has_it():
    delay = {"voltage.input_delay.delay": torch.tensor(0.03)}
    real = Furuta().with_effects(InputDelay("voltage"))
    start = torch.tensor([0.0, math.pi - 0.1, 0.0, 0.0])
    knows = furuta_policy(Furuta(integrator="rk4").with_effects(InputDelay("voltage")))
    returns = [
        float(real.roll_out(delay, policy, start, 250, reward=SwingUpReward()).returns)
        for policy in (knows, furuta_policy())
    ]
    assert returns[0] > returns[1] + 20.0


def test_mistakes_are_named():
    class Blind(Pendulum):
        sensors = Pendulum.states[:1]

    with pytest.raises(ModelError, match="no sensor of velocity"):
        pendulum_policy(Blind())
    with pytest.raises(ModelError, match="no parameter colour"):
        pendulum_policy(domains={"colour": torch.tensor(1.0)})
    for wrong in ({"noise": [1.0, 2.0]}, {"domains": {"mass": torch.ones(2, 2)}}):
        with pytest.raises(NpdrError):
            pendulum_policy(**wrong)
    for wrong in ({"temperature": 0.0}, {"replan_every": 21}, {"num_knots": 21}):
        with pytest.raises(ModelError, match="MPPI needs"):
            pendulum_policy(**wrong)


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")
def test_loops_are_not_compiled():
    with pytest.raises(Exception, match="MPPI cannot be compiled"):
        Pendulum().roll_out({}, pendulum_policy(), torch.zeros(2), 20, compile="always")
