"""The swing-up policy on the recordings and in the simulator; closed-loop rollouts."""

import math
from pathlib import Path

import pandas as pd
import pytest
import torch

from npdr_ppl.engines.common import compilation
from npdr_ppl.engines.common.compilation import has_compiler
from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import CoulombFriction, InputDelay, SensorLowPass, Tilt
from npdr_ppl.models.furuta import Furuta, SwingUpReward, initial_states
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from npdr_ppl.policies.playback import Chirp, Playback, Sinusoid

RECORDINGS = Path(__file__).parents[3] / "shared/data/quanser_qube/swing_up_500hz_5s.csv"
NAMES = tuple(state.name for state in Furuta.states)
NOMINAL = {p.name: torch.tensor(p.nominal, dtype=torch.float64) for p in Furuta.parameters}


def some_policies(num_policies, seed=0):
    generator = torch.Generator().manual_seed(seed)
    policy = FurutaSwingUp()
    noise = 0.2 * torch.randn(num_policies, 1, 1, 7, generator=generator)
    return policy.with_parameters(policy.parameters.double() + noise)


def some_domains(num_domains):
    mass = torch.linspace(0.02, 0.03, num_domains, dtype=torch.float64)
    return {"pole_mass": mass[:, None], "arm_length": (2.0 * mass + 0.035)[:, None]}


def starts(num_states):
    return initial_states(num_states, torch.Generator().manual_seed(5)).double()


@pytest.mark.skipif(not RECORDINGS.exists(), reason=f"the recordings {RECORDINGS} are absent")
def test_policy_and_reward_reproduce_the_recordings():
    """Commands follow from recorded states; returns are near the recordings' own.

    The rewards recorded by the rig, 1017 ... 1020 per episode, wrapped the errors of the rates by
    2π like angles, so that fast motion cost less; ours do not and come out 5 % lower.
    """
    policy = FurutaSwingUp()
    policy = policy.with_parameters(policy.parameters.double())
    constants = policy.constants(NOMINAL)
    returns, errors = [], []
    for _, rollout in pd.read_csv(RECORDINGS).groupby("rollout"):
        states = torch.tensor(rollout[list(NAMES)].to_numpy())[:-1].unbind(-1)
        voltage = torch.tensor(rollout["voltage"].to_numpy()[:-1])
        (command,), _ = policy.act(states, 0.0, None, constants)
        errors.append((command.clamp(-4.0, 4.0) - voltage).abs())
        returns.append(float(SwingUpReward()(states[:2], states[2:], (command,)).sum()))
    # At five of 12 500 steps the recorded digits do not tell which branch the rig was on.
    assert (torch.cat(errors) > 1e-5).sum() <= 5
    assert all(965.0 < value < 975.0 for value in returns)


@pytest.mark.slow
def test_default_gains_return_the_published_value():
    reward = SwingUpReward(arm_angle_weight=1.0)
    out = Furuta().roll_out({}, FurutaSwingUp(), starts(20), 2500, reward=reward)
    assert float(out.returns.mean()) == pytest.approx(1188.0, abs=3.0)
    assert (out.lengths == 2500).all()


def test_batch_equals_a_loop():
    policies, domains, states = some_policies(2), some_domains(3), starts(4)
    out = Furuta().roll_out(domains, policies, states, 100, reward=SwingUpReward(), record=True)
    assert out.returns.shape == (2, 3, 4)
    assert out.readings.shape == (2, 3, 4, 101, 4)
    assert out.commands.shape == (2, 3, 4, 100, 1)
    for i, j, k in [(0, 0, 0), (1, 2, 3), (0, 1, 2)]:
        one = Furuta().roll_out(
            {name: value[j, 0] for name, value in domains.items()},
            policies.with_parameters(policies.parameters[i, 0, 0]),
            states[k],
            100,
            reward=SwingUpReward(),
            record=True,
        )
        torch.testing.assert_close(out.returns[i, j, k], one.returns)
        torch.testing.assert_close(out.readings[i, j, k], one.readings)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (InputDelay("voltage"), CoulombFriction("arm"), CoulombFriction("pole")),
        (SensorLowPass("arm_velocity,pole_velocity"), Tilt("gravity"), InputDelay("voltage")),
    ],
    ids=["none", "delay and friction", "filter, tilt and delay"],
)
def test_replaying_the_commands_gives_the_same_readings(effects):
    strengths = {
        "voltage.input_delay.delay": 0.0053,
        "arm.coulomb_friction.magnitude": 1e-3,
        "pole.coulomb_friction.magnitude": 1e-4,
        "arm_velocity,pole_velocity.sensor_low_pass.time_constant": 0.01,
        "gravity.tilt.roll": 0.02,
    }
    simulator = Furuta().with_effects(*effects)
    names = {name for effect in effects for name in effect.parameter_names}
    given = {
        name: torch.tensor(value, dtype=torch.float64)
        for name, value in strengths.items()
        if name in names
    }
    start = starts(1)[0]
    out = simulator.roll_out(given, FurutaSwingUp(), start, 300, record=True)
    inputs = Inputs.single(
        out.commands, start, action_names=("voltage",), state_names=NAMES, time_step=0.002
    )
    torch.testing.assert_close(simulator.simulate(given, inputs)[0], out.readings[1:])


def test_zero_strength_changes_no_bit_in_closed_loop():
    attached = (
        InputDelay("voltage"),
        CoulombFriction("pole"),
        SensorLowPass("arm_velocity,pole_velocity"),
        Tilt("gravity"),
    )
    policies = some_policies(3)
    base = Furuta().roll_out({}, policies, starts(2), 400, reward=SwingUpReward())
    zero = {name: torch.zeros(()) for effect in attached for name in effect.parameter_names}
    changed = Furuta().with_effects(*attached)
    out = changed.roll_out(zero, policies, starts(2), 400, reward=SwingUpReward())
    assert torch.equal(out.returns, base.returns)


def test_leaving_the_bounds_ends_the_episode():
    spin = Playback(torch.full((1, 1), 4.0), ("voltage",), 0.002)
    out = Furuta().roll_out({}, spin, starts(3), 800, reward=SwingUpReward(), record=True)
    assert ((out.lengths > 50) & (out.lengths < 800)).all()
    arm = out.readings[..., 0]
    bound = math.radians(115.0)
    for i, length in enumerate(out.lengths.tolist()):
        assert arm[i, length].abs() > bound
        assert (arm[i, :length].abs() <= bound).all()
        assert (out.readings[i, length + 1 :] == 0.0).all()
        assert (out.commands[i, :length] == 4.0).all()
        assert (out.commands[i, length:] == 0.0).all()
        # The reward of the step that leaves the bounds counts, none after it.
        q = out.readings[i, :length].unbind(-1)
        reward = SwingUpReward()(q[:2], q[2:], (out.commands[i, :length, 0],))
        torch.testing.assert_close(out.returns[i], reward.sum())


def test_policy_pushes_a_pole_that_rests():
    policy = FurutaSwingUp()
    rest = (torch.zeros(()),) * 4
    (command,), _ = policy.act(rest, 0.0, None, policy.constants(NOMINAL))
    assert command != 0.0


def test_internal_model_replaces_the_domain():
    policy = FurutaSwingUp(internal_model=NOMINAL)
    changed = {**NOMINAL, "pole_mass": torch.tensor(0.03, dtype=torch.float64)}
    for ours, own in zip(
        policy.constants(changed), FurutaSwingUp().constants(NOMINAL), strict=True
    ):
        torch.testing.assert_close(ours, own)


def test_excitations():
    time = torch.tensor(0.3)
    sine = Sinusoid("torque", torch.tensor([4.5, 1.0, 0.0]))
    (command,), _ = sine.act((), time, None, sine.constants({}))
    assert float(command) == pytest.approx(4.5 * math.sin(0.6 * math.pi))
    out = Pendulum().roll_out({}, sine, torch.zeros(2), 400, record=True)
    assert out.commands.shape == (400, 1)
    chirp = Chirp("voltage", torch.tensor([1.5, 10.0, 0.0, 2.0, 0.1]))
    for t, turns in [(1.0, 10.0 - 2.5), (3.0, 10.0)]:
        (command,), _ = chirp.act((), t, None, chirp.constants({}))
        expected = 0.1 + 1.5 * math.sin(2.0 * math.pi * turns)
        assert float(command) == pytest.approx(expected, abs=1e-4)


def test_mistakes_are_named():
    with pytest.raises(ShapeError, match="7 parameters"):
        FurutaSwingUp(torch.zeros(6))
    with pytest.raises(ModelError, match="do not fit together"):
        Pendulum().roll_out({}, FurutaSwingUp(), torch.zeros(2), 10)


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")
@pytest.mark.usefixtures("short_kernels")
def test_compiled_loop_agrees_with_the_eager_one(monkeypatch):
    # Other tests compile several steps of smaller loops; here a second one doubles the time.
    monkeypatch.setattr(compilation, "_STEPS_PER_CALL", (1,))
    attached = InputDelay("voltage"), CoulombFriction("arm"), CoulombFriction("pole")
    simulator = Furuta().with_effects(*attached)
    given = {
        **some_domains(5),
        "voltage.input_delay.delay": torch.tensor(0.005, dtype=torch.float64),
        "arm.coulomb_friction.magnitude": torch.tensor(1e-3, dtype=torch.float64),
        "pole.coulomb_friction.magnitude": torch.tensor(1e-4, dtype=torch.float64),
    }
    for num_policies in (2, 3):  # another size does not compile anew
        policies = some_policies(num_policies)
        eager, fast = (
            simulator.roll_out(
                given, policies, starts(2), 47, reward=SwingUpReward(), compile=mode
            )
            for mode in ("never", "always")
        )
        torch.testing.assert_close(fast.returns, eager.returns, rtol=1e-6, atol=1e-6)
        assert torch.equal(fast.lengths, eager.lengths)
