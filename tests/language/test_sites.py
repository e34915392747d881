"""The black-box site as a citizen of Pyro: plates, Predictive, condition, density."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO
from pyro.infer.autoguide import AutoNormal

import npdr_ppl as npdr
from npdr_ppl.errors import IntractableError, ModelError, ShapeError, SimulationError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.pendulum import Pendulum, pendulum

NUM_STEPS = 30


@pytest.fixture
def inputs():
    return Inputs.single(
        torch.full((NUM_STEPS, 1), 2.0, dtype=torch.float64),
        torch.zeros(2),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.02,
    )


def test_one_draw_has_the_event_shape_only(inputs):
    trajectory = pendulum(inputs)
    assert trajectory.shape == (1, NUM_STEPS, 2)


def test_plates_are_the_batch(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
        trajectory = npdr.simulate("trajectory", Pendulum(), {"mass": mass}, inputs)
    assert trajectory.shape == (3, 1, NUM_STEPS, 2)
    for i in range(3):
        alone = npdr.simulate("alone", Pendulum(), {"mass": mass[i]}, inputs)
        torch.testing.assert_close(trajectory[i], alone, rtol=1e-12, atol=1e-12)


def test_parallel_predictive_equals_sequential_given_the_parameters(inputs):
    parallel = Predictive(pendulum, num_samples=6, parallel=True)(inputs)
    given = {name: parallel[name] for name in ("mass", "length")}
    sequential = Predictive(pendulum, posterior_samples=given, parallel=False)(inputs)
    torch.testing.assert_close(parallel["trajectory"], sequential["trajectory"])


def test_condition_fixes_a_parameter_and_a_trajectory(inputs):
    fixed = pyro.condition(pendulum, data={"mass": torch.tensor(1.0), "length": torch.tensor(1.0)})
    torch.testing.assert_close(fixed(inputs), fixed(inputs))
    observed = torch.zeros(1, NUM_STEPS, 2)
    trace = poutine.trace(pyro.condition(pendulum, data={"trajectory": observed}))
    assert trace.get_trace(inputs).nodes["trajectory"]["value"] is observed


def test_several_sites_in_one_model(inputs):
    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
        first = npdr.simulate("first", Pendulum(), {"mass": mass}, inputs)
        second = npdr.simulate("second", Pendulum(), {"mass": 2 * mass}, inputs)
        return first, second

    draws = Predictive(model, num_samples=4, parallel=True)(inputs)
    assert draws["first"].shape == draws["second"].shape == (4, 1, NUM_STEPS, 2)


def test_intractable_density_names_the_site_and_the_way_out(inputs):
    conditioned = pyro.condition(pendulum, data={"trajectory": torch.zeros(1, NUM_STEPS, 2)})
    with pytest.raises(IntractableError, match=r"'trajectory' is intractable.*npdr\.infer.*noise"):
        poutine.trace(conditioned).get_trace(inputs).log_prob_sum()


def test_noise_gives_the_normal_density(inputs):
    clean = pyro.condition(pendulum, data={"mass": torch.tensor(1.0), "length": torch.tensor(1.0)})
    trajectory = clean(inputs)
    observed = trajectory + 0.1
    scales = {"angle": 0.2, "velocity": 0.5}

    def model(inputs):
        return npdr.simulate("trajectory", Pendulum(), {}, inputs, noise=scales)

    site = poutine.trace(pyro.condition(model, data={"trajectory": observed})).get_trace(inputs)
    expected = sum(
        torch.distributions.Normal(0.0, scale).log_prob(torch.tensor(0.1)) * NUM_STEPS
        for scale in scales.values()
    )
    # Parameters were float32, the simulation is float64.
    torch.testing.assert_close(site.log_prob_sum(), expected.double(), rtol=1e-4, atol=1e-4)


def test_pointwise_densities_sum_to_the_density(inputs):
    two = Inputs(
        **{
            **{name: getattr(inputs, name) for name in inputs.__dataclass_fields__},
            "actions": inputs.actions.expand(2, -1, -1),
            "initial_readings": inputs.initial_readings.expand(2, -1),
            "initial_values": inputs.initial_values.expand(2, -1),
            "past_actions": inputs.past_actions.expand(2, -1, -1),
            "mask": torch.stack([torch.ones(NUM_STEPS), torch.arange(NUM_STEPS) < 7]).bool(),
            "rollout": torch.arange(2),
            "start": torch.zeros(2, dtype=torch.long),
        }
    )

    def model(inputs):
        return npdr.simulate("trajectory", Pendulum(), {}, inputs, noise=0.1)

    value = model(two)
    assert bool((value[1, 7:] == 0).all())
    box = poutine.trace(model).get_trace(two).nodes["trajectory"]["fn"]
    pointwise, event_dim = box.pointwise_log_prob(value)
    assert event_dim == 3
    torch.testing.assert_close(pointwise.sum(), box.log_prob(value))
    # Padding carries no information.
    changed = value.clone()
    changed[1, 7:] = 5.0
    torch.testing.assert_close(box.log_prob(changed), box.log_prob(value))


def test_noise_for_unknown_channels_is_refused(inputs):
    with pytest.raises(ModelError, match="noise names the channels"):
        npdr.simulate("trajectory", Pendulum(), {}, inputs, noise={"speed": 0.1})


def test_unknown_parameter_and_bad_shapes_are_refused(inputs):
    with pytest.raises(ModelError, match="no parameter weight"):
        npdr.simulate("trajectory", Pendulum(), {"weight": torch.ones(())}, inputs)
    parameters = {"mass": torch.ones(2), "length": torch.ones(3)}
    with pytest.raises(ShapeError, match=r"mass: \(2,\), length: \(3,\)"):
        npdr.simulate("trajectory", Pendulum(), parameters, inputs)
    with pytest.raises(ModelError, match="needs inputs"):
        npdr.simulate("trajectory", Pendulum(), {})


def test_plain_function_with_vector_parameters():
    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        return npdr.simulate("x", lambda theta: theta.cumsum(-1), {"theta": theta})

    assert model().shape == (2,)
    draws = Predictive(model, num_samples=5, parallel=True)()
    torch.testing.assert_close(draws["x"], draws["theta"].cumsum(-1))


def test_plain_function_inside_plates():
    def model():
        shared = pyro.sample("shared", dist.Normal(0.0, 1.0))
        with pyro.plate("devices", 3):
            own = pyro.sample("own", dist.Normal(shared, 1.0))
            return npdr.simulate(
                "x",
                lambda own, shared: torch.stack([own, shared], -1),
                dict(own=own, shared=shared),
            )

    draws = Predictive(model, num_samples=5, parallel=True)()
    assert draws["x"].shape == (5, 3, 2)
    torch.testing.assert_close(draws["x"][..., 1], draws["shared"].expand(5, 3))


def test_function_that_forgets_the_batch_is_refused():
    with pytest.raises(SimulationError, match="first dimension is the batch"):
        npdr.simulate("x", lambda theta: theta.sum(), {"theta": torch.ones(4, 2)})


def linear_model(noise):
    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0))
        return npdr.simulate(
            "x",
            lambda theta: theta[:, None] * torch.tensor([1.0, 2.0]),
            {"theta": theta},
            noise=noise,
        )

    return model


@pytest.mark.slow
def test_nuts_on_a_black_box_with_noise_matches_the_closed_form():
    observed = torch.tensor([0.5, 1.5])
    conditioned = pyro.condition(linear_model(0.5), data={"x": observed})
    pyro.set_rng_seed(0)
    mcmc = MCMC(NUTS(conditioned), num_samples=800, warmup_steps=200, disable_progbar=True)
    mcmc.run()
    draws = mcmc.get_samples()["theta"]
    precision = 1 + 5 / 0.25
    mean = (0.5 + 3.0) / 0.25 / precision
    # Monte-Carlo standard error with an effective sample size of at least 200; 4 of them.
    assert abs(draws.mean() - mean) < 4 * precision**-0.5 / 200**0.5
    assert abs(draws.std() * precision**0.5 - 1) < 4 / (2 * 200) ** 0.5


@pytest.mark.slow
def test_svi_runs_on_a_black_box_with_noise():
    conditioned = pyro.condition(linear_model(0.5), data={"x": torch.tensor([0.5, 1.5])})
    pyro.set_rng_seed(0)
    pyro.clear_param_store()
    guide = AutoNormal(conditioned)
    svi = SVI(conditioned, guide, pyro.optim.Adam({"lr": 0.05}), Trace_ELBO(num_particles=8))
    for _ in range(300):
        svi.step()
    assert abs(guide.median()["theta"].item() - 14.0 / 21.0) < 0.1


def test_nuts_reaches_through_a_differentiable_simulator(inputs):
    observed = pyro.condition(
        pendulum, data={"mass": torch.tensor(1.0), "length": torch.tensor(1.0)}
    )(inputs)

    def model(inputs):
        return pendulum(inputs, noise=0.05)

    conditioned = pyro.condition(model, data={"trajectory": observed})
    pyro.set_rng_seed(0)
    mcmc = MCMC(NUTS(conditioned), num_samples=20, warmup_steps=20, disable_progbar=True)
    mcmc.run(inputs)
    draws = mcmc.get_samples()
    gain = draws["mass"] * draws["length"] ** 2
    # A short push from rest determines the inertia and nothing else.
    assert abs(gain.mean() - 1) < 0.2
