"""A plain function of a batch takes rollouts, as any simulator does."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import DataError, ModelError, SimulationError
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.models.effects import (
    Backlash,
    Bias,
    CoulombFriction,
    HardeningSpring,
    InputDelay,
    JointElasticity,
    StribeckFriction,
    ViscousFriction,
)
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.posterior.prepare import prepare

STEP = 0.02


def rod(parameters, initial_state, actions, time_step):
    """The zoo's pendulum, written out: semi-implicit Euler steps."""
    angle, velocity = initial_state.unbind(-1)
    mass, length = parameters["mass"], parameters["length"]
    states = []
    for torque in actions[..., 0].unbind(-1):
        weight = 0.5 * mass * length * 9.81 * torch.sin(angle)
        velocity = velocity + time_step * (torque - weight) / (mass * length**2 / 3.0)
        angle = angle + time_step * velocity
        states.append(torch.stack([angle, velocity], dim=-1))
    return torch.stack(states, dim=-2)


def simulator(function=rod, **changed):
    declared = {
        "states": Pendulum.sensors,
        "actions": [npdr.Channel("torque", "N m", -4.5, 4.5)],
        "parameters": [npdr.Parameter("mass", "kg", 1.0), npdr.Parameter("length", "m", 1.0)],
        "time_step": STEP,
    }
    return npdr.FunctionSimulator(function, **(declared | changed))


def model(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.5, 2.0))
    length = pyro.sample("length", dist.Uniform(0.5, 1.5))
    return npdr.simulate("swing", simulator(), {"mass": mass, "length": length}, inputs)


def recording(num_steps=400, *, delay=0, substeps=1):
    rng = np.random.default_rng(0)
    time = STEP * np.arange(num_steps)
    torque = 2.0 * np.sin(3.1 * time) + np.sign(np.sin(5.7 * time))
    late = np.concatenate((np.zeros(delay), torque[: num_steps - delay]))
    values = {"mass": torch.tensor([1.1]), "length": torch.tensor([0.9])}
    start = torch.tensor([[0.3, 0.0]], dtype=torch.float64)
    held = torch.tensor(late).repeat_interleave(substeps)[None, :, None]
    states = rod(values, start, held, STEP / substeps)[0, substeps - 1 :: substeps].numpy()
    readings = np.concatenate((start.numpy(), states))
    readings += rng.normal(0.0, [1e-3, 1e-2], readings.shape)
    return npdr.Rollouts.from_arrays(
        [readings], [torque[:, None]], channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=STEP,
    )  # fmt: skip


def test_it_simulates_all_draws_and_segments_in_one_call():
    calls = []

    def noting(parameters, initial_state, actions, time_step):
        calls.append((initial_state.shape, actions.shape, parameters["mass"].shape, time_step))
        return rod(parameters, initial_state, actions, time_step)

    inputs = recording().inputs(100)
    masses = torch.tensor([0.8, 1.0, 1.2])
    found = simulator(noting).simulate({"mass": masses}, inputs)
    assert found.shape == (3, 4, 100, 2)
    assert calls == [((12, 2), (12, 100, 1), (12,), STEP)]
    assert not torch.equal(found[0], found[1])


def test_parameters_and_a_hidden_delay_are_found():
    fitted = prepare(model, recording(), npdr.DataOptions()).hypothesis
    assert fitted is not None
    found = {name: float(value) for name, value in fitted.parameters.items()}
    assert found == pytest.approx({"mass": 1.1, "length": 0.9}, rel=0.01)
    late = prepare(add_effect(model, InputDelay("torque")), recording(delay=1), npdr.DataOptions())
    assert late.hypothesis is not None
    delay = float(late.hypothesis.parameters["torque.input_delay.delay"])
    assert delay == pytest.approx(STEP, abs=1e-3)


HINGE = npdr.Port("hinge", "force", "N m", rated=4.5, rated_speed=5.0)


def pushed_rod(parameters, initial_state, actions, time_step, forces):
    """The rod with forces of effects, in three steps of the midpoint method per time step."""
    angle, velocity = initial_state.unbind(-1)
    mass, length, step = parameters["mass"], parameters["length"], time_step / 3
    states = []
    for torque in (actions + forces)[..., 0].unbind(-1):
        for _ in range(3):
            middle = angle + 0.5 * step * velocity
            weight = 0.5 * mass * length * 9.81 * torch.sin(middle)
            acceleration = (torque - weight) / (mass * length**2 / 3.0)
            angle = angle + step * (velocity + 0.5 * step * acceleration)
            velocity = velocity + step * acceleration
        states.append(torch.stack([angle, velocity], dim=-1))
    return torch.stack(states, dim=-2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect",
    [
        Bias("hinge"),
        ViscousFriction("hinge"),
        CoulombFriction("hinge"),
        HardeningSpring("hinge"),
        StribeckFriction("hinge"),
        JointElasticity("hinge"),
        Backlash("hinge"),
    ],
    ids=lambda effect: effect.id,
)
def test_forces_of_effects_move_a_function_as_they_move_an_engine(effect):
    """The truth is the pendulum of the zoo in fine steps; its error in long steps is the scale.

    Elasticity and play change much within a step of 20 ms, the other effects do not.
    """
    engine = Pendulum(integrator="rk4", substeps=16).with_effects(effect)
    coarse = Pendulum(integrator="rk4").with_effects(effect)
    plain = simulator(pushed_rod, forces={"angle": HINGE})
    inputs = recording().inputs(100)
    values = {
        f"hinge.{effect.id}.{name}": prior.icdf(torch.tensor([0.3, 0.7]))
        for name, prior in effect.default_priors(HINGE).items()
    }
    without = plain.simulate({}, inputs)
    true = engine.simulate(values, inputs)
    found = plain.with_effects(effect).simulate(values, inputs)
    change, scale = (true - without).norm(), (coarse.simulate(values, inputs) - true).norm()
    assert change > 0.0 and (found - true).norm() < 3.0 * scale + 1e-2 * change
    if effect.strength:
        none = {f"hinge.{effect.id}.{name}": torch.zeros(2) for name in effect.strength}
        still = plain.with_effects(effect).simulate({**values, **none}, inputs)
        torch.testing.assert_close(still, without.expand_as(still), rtol=0.0, atol=1e-6)


@pytest.mark.slow
def test_dry_friction_that_an_own_function_lacks_is_found():
    engine = Pendulum(integrator="rk4", substeps=16).with_effects(CoulombFriction("hinge"))
    given = recording()
    values = {"mass": 1.1, "length": 0.9, "hinge.coulomb_friction.magnitude": 0.3}
    values = {name: torch.tensor([value]) for name, value in values.items()}
    true = engine.simulate(values, given.inputs(None, "recorded"))[0, 0].double().numpy()
    readings = np.concatenate((given.readings[0][:1], true))
    readings[1:] += np.random.default_rng(2).normal(0.0, [1e-3, 1e-2], true.shape)
    rollouts = npdr.Rollouts.from_arrays(
        [readings], [given.actions[0]], channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=STEP,
    )  # fmt: skip

    def pushed(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.5, 2.0))
        length = pyro.sample("length", dist.Uniform(0.5, 1.5))
        own = simulator(pushed_rod, forces={"angle": HINGE})
        return npdr.simulate("swing", own, {"mass": mass, "length": length}, inputs)

    search = npdr.DiscoveryOptions(max_effects=1)
    found = npdr.discover(pushed, rollouts, search=search, progress=False)
    assert [finding.effect.name for finding in found.effects] == ["hinge.coulomb_friction"]


def test_finer_steps_call_the_function_with_a_part_of_the_time_step():
    free = [npdr.Channel("angle", "rad"), npdr.Channel("velocity", "rad/s", rate_of="angle")]
    rollouts, coarse = recording(50), simulator(states=free)
    inputs = rollouts.inputs(initial_state="recorded")
    finer = coarse.with_finer_steps()
    assert finer.with_finer_steps() is None
    assert coarse.with_coarser_steps() is None
    own = finer.with_coarser_steps()
    values = {"mass": torch.tensor([1.1]), "length": torch.tensor([0.9])}
    assert torch.equal(own.simulate(values, inputs), coarse.simulate(values, inputs))
    start = torch.tensor(rollouts.readings[0][:1])
    actions = inputs.actions.double().reshape(1, -1, 1).repeat_interleave(64, dim=1)
    exact = rod(values, start, actions, STEP / 64)[:, 63::64]
    errors = [
        float((each.simulate(values, inputs).reshape(exact.shape) - exact).abs().max())
        for each in (coarse, finer)
    ]
    assert errors[1] < 0.1 * errors[0]


def test_a_function_that_ignores_the_time_step_has_no_finer_steps():
    def learned(parameters, initial_state, actions, time_step):
        return rod(parameters, initial_state, actions, STEP)

    def lag(parameters, initial_state, actions, time_step):
        """Two steps of it change the state by only 1.3 times as much as one."""
        state, states = initial_state, []
        for action in actions.unbind(1):
            state = 0.3 * state + 0.7 * action
            states.append(state)
        return torch.stack(states, dim=1)

    def fragile(parameters, initial_state, actions, time_step):
        raise ValueError("these states do not suit it")

    assert simulator(learned).with_finer_steps() is None
    assert simulator(fragile).with_finer_steps() is None
    assert simulator(lag).with_finer_steps() is None


def test_wrapped_states_stay_within_their_bounds_and_forces_act_in_finer_steps():
    def turning(parameters, initial_state, actions, time_step, forces):
        """A heading between −π and π, in Euler steps."""
        heading, rate = initial_state.unbind(-1)
        states = []
        for k in range(actions.shape[1]):
            heading = torch.remainder(heading + time_step * rate + math.pi, 2 * math.pi) - math.pi
            rate = rate + time_step * (actions[:, k, 0] + forces[:, k, 0])
            states.append(torch.stack([heading, rate], dim=-1))
        return torch.stack(states, dim=1)

    wrapped = npdr.FunctionSimulator(
        turning,
        states=[
            npdr.Channel("angle", "rad", -math.pi, math.pi),
            npdr.Channel("velocity", "rad/s", rate_of="angle"),
        ],
        actions=[npdr.Channel("torque", "N m", -4.5, 4.5)],
        parameters=[],
        time_step=STEP,
        forces={"angle": npdr.Port("base", "force", "N m", 4.5, 5.0)},
    )
    rollouts = recording(400)
    inputs = rollouts.inputs(initial_state="recorded")
    slowed = wrapped.with_effects(ViscousFriction("base"))
    drag = {"base.viscous_friction.damping": torch.tensor(0.4).double()}
    finer = slowed.with_finer_steps()
    errors = []
    for simulated in (slowed, finer):
        angle, rate = simulated.simulate(drag, inputs)[0].unbind(-1)
        assert float(angle.abs().max()) <= math.pi + 1e-9
        # The rate follows ω' = u − c ω, step by step.
        decay, exact = math.exp(-0.4 * STEP), [inputs.initial_values[0, 1].double()]
        for torque in inputs.actions[0, :, 0].double():
            exact.append(exact[-1] * decay + torque * (1.0 - decay) / 0.4)
        errors.append(float((rate - torch.stack(exact[1:])).abs().max()))
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.slow
def test_coarse_steps_of_an_own_function_do_not_bias_its_parameters():
    found = npdr.discover(model, recording(substeps=50), seed=0)
    assert found.verdict == "none"
    for name, true in (("mass", 1.1), ("length", 0.9)):
        estimate = found.parameters[name]
        assert abs(estimate.mean - true) < 3.5 * estimate.sd


def test_commands_are_clamped_and_free_motion_needs_none():
    inputs = recording().inputs(100)
    strong = simulator(actions=[npdr.Channel("torque", "N m", -0.1, 0.1)])
    assert not torch.equal(strong.simulate({}, inputs)[0], simulator().simulate({}, inputs)[0])

    def fall(parameters, initial_state, actions, time_step):
        time = time_step * torch.arange(1, actions.shape[1] + 1)
        height = initial_state[:, :1] - 0.5 * parameters["gravity"][:, None] * time**2
        return height[..., None]

    falling = npdr.FunctionSimulator(
        fall, states=[npdr.Channel("height", "m")],
        parameters=[npdr.Parameter("gravity", "m/s²", 9.81)], time_step=0.1,
    )  # fmt: skip
    drop = npdr.Rollouts.from_arrays(
        [1.0 - 4.905 * (0.1 * np.arange(5)[:, None]) ** 2],
        channel_names=("height",), time_step=0.1,
    )  # fmt: skip
    inputs = drop.inputs(None, "recorded")
    assert torch.allclose(falling.simulate({}, inputs), drop.observation(inputs))


def test_a_zoo_pendulum_takes_a_free_swing():
    """Recordings without actions work with any model; the truth is a pendulum without torque."""
    time = STEP * np.arange(300)
    angle = 0.1 * np.cos(math.sqrt(1.5 * 9.81 / 0.9) * time)
    noise = np.random.default_rng(1).normal(0.0, 1e-4, len(time))
    swing = npdr.Rollouts.from_arrays(
        [(angle + noise)[:, None]], channel_names=("angle",), time_step=STEP
    )

    def free(inputs):
        length = pyro.sample("length", dist.Uniform(0.5, 1.5))
        return npdr.simulate("swing", Pendulum(), {"length": length}, inputs)

    prepared = prepare(free, swing, npdr.DataOptions())
    assert prepared.rollouts.notes == ("No commands were recorded; zero is assumed for torque.",)
    assert prepared.hypothesis is not None
    # The small swing's frequency; at 0.1 rad it is 0.06 % lower.
    assert float(prepared.hypothesis.parameters["length"]) == pytest.approx(0.9, rel=5e-3)


def test_mistakes_get_one_sentence():
    with pytest.raises(ModelError, match="mass has two meanings"):
        simulator(states=[npdr.Channel("mass", "kg")])
    with pytest.raises(ModelError, match="has no states"):
        simulator(states=[])
    with pytest.raises(ModelError, match="position among the states"):
        simulator(pushed_rod, forces={"velocity": HINGE})
    with pytest.raises(ModelError, match="of kind sensor"):
        simulator(pushed_rod, forces={"angle": npdr.Port("hinge", "sensor", "N m")})
    with pytest.raises(ModelError, match="No state is the rate of angle"):
        simulator(pushed_rod, states=[npdr.Channel("angle", "rad")], forces={"angle": HINGE})
    wrong = simulator(lambda *_: torch.zeros(3))
    with pytest.raises(SimulationError, match=r"a tensor of shape \(4, 100, 2\); got \(3,\)"):
        wrong.simulate({}, recording().inputs(100))

    def without_inputs():
        mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
        return npdr.simulate("x", lambda mean: mean, {"mean": mean})

    with pytest.raises(DataError, match=r"npdr\.FunctionSimulator"):
        npdr.infer(without_inputs, recording(), progress=False)
