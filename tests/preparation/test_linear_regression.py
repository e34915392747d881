"""Regression from recorded motion to a posterior over each model's own parameters."""

import math
from dataclasses import replace
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import BackendError, DataError, ModelError
from npdr_ppl.inference.parts.samplers.conjugate import linear_posterior
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.prior import Prior
from npdr_ppl.models import zoo
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.effects import (
    Bias,
    CoulombFriction,
    InputDelay,
    QuadraticDrag,
    Spring,
)
from npdr_ppl.models.emps import Emps
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.preparation.binding import bind, problem_of
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import score
from npdr_ppl.preparation.linear_regression import LinearForm, regression_of
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.differentiation import Smoothing

NAME = "bayesian-linear-regression"
DATA = Path(__file__).parents[3] / "shared/data"
FURUTA = DATA / "quanser_qube/swing_up_500hz_5s.csv"
EMPS = DATA / "emps/identification_1khz_25s.csv"

TRUTH = {
    Pendulum: {"mass": 0.8, "length": 1.2},
    Furuta: {"arm_mass": 0.11, "pole_length": 0.12, "arm_damping": 2e-4, "pole_damping": 2e-5},
    CartPole: {"cart_mass": 0.7, "pole_mass": 0.3, "pole_length": 0.5, "pole_damping": 0.01},
    Emps: {"mass": 90.0, "viscous_friction": 250.0},
}
AMPLITUDE = {Pendulum: 4.0, Furuta: 2.5, CartPole: 15.0, Emps: 8.0}
MODELS = {Pendulum: "pendulum", Furuta: "furuta", CartPole: "cart_pole", Emps: "emps"}


def record(simulator, parameters, time_step, num_steps=3000, channels=None):
    """Simulates a recording without noise under a sum of sinusoids, by a fourth-order method."""
    time = time_step * torch.arange(num_steps, dtype=torch.float64)
    (action,) = simulator.actions
    command = sum(torch.cos(2 * math.pi * f * time) for f in (1.1, 1.6, 2.3)) / 3.0
    inputs = Inputs.single(
        AMPLITUDE[type(simulator)] * command[:, None],
        torch.zeros(len(simulator.states)),
        action_names=(action.name,),
        state_names=tuple(state.name for state in simulator.states),
        time_step=time_step,
    )
    values = {name: torch.tensor(v, dtype=torch.float64) for name, v in parameters.items()}
    trajectory = simulator.simulate(values, inputs)[0]
    rollouts = Rollouts.from_arrays(
        readings=[torch.cat((torch.zeros_like(trajectory[:1]), trajectory)).numpy()],
        actions=[inputs.actions[0].numpy()],
        channel_names=[sensor.name for sensor in simulator.sensors],
        action_names=[action.name],
        time_step=time_step,
    )
    return rollouts if channels is None else rollouts.select(channels)


def regress(model, rollouts, **options):
    """The regression's own posterior, which no simulation has corrected."""
    return npdr.infer(
        model,
        rollouts,
        backend=backend(NAME, **options),
        options=npdr.DataOptions(initial_state="estimated"),
        progress=False,
    )


@pytest.mark.parametrize("cls", TRUTH, ids=lambda cls: cls.__name__)
def test_noiseless_motion_gives_the_parameters_back(cls):
    model = zoo()[MODELS[cls]].model
    simulator = cls(integrator="rk4")
    rollouts = record(simulator, TRUTH[cls], 0.002)
    problem = problem_of(bind(model, rollouts, DataOptions()))
    regression = problem.regression(Smoothing())
    # At the true values of what cannot be told, the base parameters' mean is the truth.
    prior = Prior(model, (rollouts.inputs(),))
    names = [site.name for site in prior.sites]
    truth = {p.name: p.nominal for p in simulator.parameters} | TRUTH[cls]
    values = {name: torch.tensor([truth[name]], dtype=torch.float64) for name in names}
    expected = regression.from_reference(prior.to_reference(values))[0]
    posterior = linear_posterior(
        regression.regressors,
        regression.targets,
        regression.prior_mean,
        regression.prior_covariance,
    )
    torch.testing.assert_close(posterior.mean, expected, rtol=3e-4, atol=0.0)
    z, is_plausible = regression.to_reference(posterior.mean[None], prior.to_reference(values))
    assert is_plausible.all()
    for name, value in prior.to_parameters(z).items():
        torch.testing.assert_close(value.double(), values[name], rtol=1e-3, atol=0.0)


@pytest.mark.slow
def test_effects_add_columns():
    simulator = Emps(integrator="rk4").with_effects(
        CoulombFriction("carriage"),
        Bias("carriage"),
        Spring("carriage"),
        QuadraticDrag("carriage"),
    )
    model = zoo()["emps"].model
    for effect in simulator.effects:
        model = npdr.add_effect(model, effect)
    truth = {
        "mass": 90.0,
        "viscous_friction": 250.0,
        "carriage.coulomb_friction.magnitude": 15.0,
        "carriage.bias.offset": 2.0,
        "carriage.spring.stiffness": 8.0,
        "carriage.spring.rest": 0.5,
        "carriage.quadratic_drag.drag": 300.0,
    }
    posterior = regress(model, record(simulator, truth, 0.002, 5000, ["position"]))
    draws = posterior.sample(500)
    for name, value in truth.items():
        error = abs(float(draws[name].double().mean()) - value)
        assert error < 0.05 * abs(value) + 3.0 * float(draws[name].std()), name


@pytest.mark.slow
def test_what_a_model_fixes_need_not_be_found():
    """With the masses and the damping fixed, three of the cart-pole's parameters remain."""

    def known_masses(inputs):
        parameters = {
            "pole_length": pyro.sample("pole_length", dist.Uniform(0.2, 1.2)),
            "cart_mass": torch.tensor(1.0),
            "pole_mass": torch.tensor(0.2),
        }
        return npdr.simulate("trajectory", CartPole(), parameters, inputs)

    def known_length(inputs):
        parameters = {
            "pole_mass": pyro.sample("pole_mass", dist.Uniform(0.05, 0.5)),
            "cart_mass": pyro.sample("cart_mass", dist.Uniform(0.3, 2.0)),
            "pole_length": torch.tensor(0.5),
            "cart_damping": pyro.sample("cart_damping", dist.LogNormal(-1.0, 1.0)),
        }
        return npdr.simulate("trajectory", CartPole(), parameters, inputs)

    rollouts = record(CartPole(integrator="rk4"), {"pole_length": 0.5}, 0.002)
    draws = regress(known_length, rollouts).sample(200)
    for name, value in {"pole_mass": 0.2, "cart_mass": 1.0, "cart_damping": 0.5}.items():
        assert draws[name].double().mean() == pytest.approx(value, rel=5e-3)
    # The length alone bends: moment and inertia are no longer in proportion.
    with pytest.raises(BackendError, match=r"vary in 2 directions .* are 1 \(pole_length\)"):
        regress(known_masses, rollouts)


def test_noise_of_readings_shows_in_the_posterior():
    """Draws cover the truth: within 4.5 standard deviations, on readings with noise."""
    rollouts = record(Pendulum(integrator="rk4"), TRUTH[Pendulum], 0.005, 2000, ["angle"])
    generator = torch.Generator().manual_seed(0)
    noise = 2e-3 * torch.randn(2001, 1, generator=generator, dtype=torch.float64).numpy()
    noisy = replace(rollouts, readings=(rollouts.readings[0] + noise,))
    draws = regress(zoo()["pendulum"].model, noisy).sample(2000)
    for name, value in TRUTH[Pendulum].items():
        z = (float(draws[name].double().mean()) - value) / float(draws[name].std())
        assert abs(z) < 4.5
        assert float(draws[name].std()) > 1e-5


@pytest.mark.slow
def test_posteriors_are_whole(tmp_path, caplog):
    """Saved, loaded, exported; draws on the support; the most likely one is the densest."""
    rollouts = record(Furuta(integrator="rk4"), TRUTH[Furuta], 0.002, 1500)
    model = zoo()["furuta"].model
    posterior = regress(model, rollouts)
    (info,) = posterior.provenance.rounds
    assert info.num_simulations == 0
    assert 0 < info.losses["implausible"] < info.losses["draws"]
    assert "are implausible" in caplog.text
    draws = posterior.sample(500)
    assert Prior(model, (rollouts.inputs(),)).on_support(draws).all()
    assert posterior.log_prob(draws).isfinite().all()
    posterior.save(tmp_path / "saved")
    loaded = npdr.Posterior.load(tmp_path / "saved", model)
    assert torch.equal(loaded.sample(50)["arm_mass"], posterior.sample(50)["arm_mass"])
    again = npdr.infer(
        model, rollouts, backend=NAME, rounds=3,
        options=npdr.DataOptions(initial_state="estimated"),
        checkpoint=tmp_path / "run", progress=False,
    )  # fmt: skip
    assert len(again.provenance.rounds) == 1
    assert torch.equal(again.sample(50)["arm_mass"], posterior.sample(50)["arm_mass"])


def test_the_density_is_that_of_the_draws():
    """Over the pendulum's two parameters: the mass of a box by counting and by quadrature."""
    rollouts = record(Pendulum(integrator="rk4"), TRUTH[Pendulum], 0.005, 1200, ["angle"])
    generator = torch.Generator().manual_seed(1)
    noise = 5e-3 * torch.randn(1201, 1, generator=generator, dtype=torch.float64).numpy()
    posterior = regress(
        zoo()["pendulum"].model, replace(rollouts, readings=(rollouts.readings[0] + noise,))
    )
    draws = posterior.sample(20_000)
    low = {name: value.double().quantile(0.3) for name, value in draws.items()}
    high = {name: value.double().quantile(0.8) for name, value in draws.items()}
    steps = (torch.arange(40, dtype=torch.float64) + 0.5) / 40
    mass, length = torch.meshgrid(
        *(low[n] + steps * (high[n] - low[n]) for n in ("mass", "length")), indexing="ij"
    )
    # The model samples in float32, finer than the grid but not than the differences within.
    density = posterior.log_prob({"mass": mass.flatten(), "length": length.flatten()}).exp()
    area = math.prod(float(high[n] - low[n]) / 40 for n in low)
    inside = torch.stack([(v > low[n]) & (v < high[n]) for n, v in draws.items()]).all(0)
    share = float(inside.double().mean())
    error = 4.5 * (share * (1 - share) / 20_000) ** 0.5
    assert abs(float(density.sum()) * area - share) < error + 0.02 * share


def test_a_simulator_without_inverse_dynamics_is_told_what_to_declare():
    class Unknown(Pendulum):
        inverse_dynamics = None

    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        return npdr.simulate("trajectory", Unknown(), {"mass": mass}, inputs)

    rollouts = record(Pendulum(), TRUTH[Pendulum], 0.02, 200)
    with pytest.raises(ModelError, match="Unknown cannot be fitted .* attribute inverse_dynamics"):
        regress(model, rollouts)


def test_models_of_another_form_are_refused():
    rollouts = record(Pendulum(), TRUTH[Pendulum], 0.02, 200)
    pendulum = zoo()["pendulum"].model
    with pytest.raises(BackendError, match="cannot infer torque.input_delay"):
        regress(npdr.add_effect(pendulum, InputDelay("torque")), rollouts)

    def renamed(inputs):
        mass = pyro.sample("m", dist.Uniform(0.3, 1.7))
        return npdr.simulate("trajectory", Pendulum(), {"mass": mass}, inputs)

    with pytest.raises(BackendError, match="parameters of Pendulum by name.*'m'"):
        regress(renamed, rollouts)

    def backwards(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        parameters = {
            "mass": mass,
            "length": pyro.sample("length", dist.Uniform(0.3, 1.7)),
            "gravity": pyro.sample("gravity", dist.Normal(9.81 + mass, 0.1)),
        }
        return npdr.simulate("trajectory", Pendulum(), parameters, inputs)

    with pytest.raises(BackendError, match="sample gravity first"):
        regress(backwards, rollouts)

    def plain():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0))
        npdr.simulate("x", lambda theta: theta[:, None], {"theta": theta})

    with pytest.raises(BackendError, match="declares inverse_dynamics"):
        regress(plain, torch.tensor([0.5]))


def test_recordings_that_do_not_do_are_refused():
    rollouts = record(Pendulum(), TRUTH[Pendulum], 0.02, 200)
    pendulum = zoo()["pendulum"].model
    with pytest.raises(DataError, match="differentiates position readings, but angle"):
        linear_regression_of(pendulum, rollouts.select(["velocity"]))
    short = record(Pendulum(), TRUTH[Pendulum], 0.02, 40)
    with pytest.raises(DataError, match="at least 64 samples"):
        regress(pendulum, short)
    with pytest.raises(DataError, match="too few for 2 base parameters"):
        regress(pendulum, rollouts, position_cutoff=5.0, parallel_cutoff=1.0)


def linear_regression_of(model, rollouts):
    prior = Prior(model, (rollouts.inputs(initial_state="recorded"),))
    (box,) = prior.black_boxes.values()
    return regression_of(prior, box, rollouts, Smoothing())


def test_nominal_values_off_the_prior_are_marked():
    def model(inputs):
        parameters = {
            "mass": pyro.sample("mass", dist.Uniform(1.2, 1.7)),
            "length": pyro.sample("length", dist.Uniform(0.3, 1.7)),
            "gravity": pyro.sample("gravity", dist.Uniform(9.0, 10.0)),
        }
        return npdr.simulate("trajectory", Pendulum(), parameters, inputs)

    rollouts = record(Pendulum(), TRUTH[Pendulum], 0.02, 200)
    prior = Prior(model, (rollouts.inputs(),))
    (box,) = prior.black_boxes.values()
    form = LinearForm(prior, box)
    nominal = form.nominal()
    assert nominal.isnan().tolist() == [True, False, False]
    parameters = prior.to_parameters(nominal.nan_to_num()[None])
    assert parameters["gravity"].item() == pytest.approx(9.81)
    assert form.determined.tolist() == [True, True, False]


@pytest.mark.slow
@pytest.mark.skipif(not FURUTA.exists(), reason=f"the recordings {FURUTA} are absent")
def test_the_real_furuta_pendulum_is_fitted_better_than_in_the_paper():
    rollouts = Rollouts.from_csv(FURUTA)
    furuta = zoo()["furuta"].model
    posterior = regress(furuta, rollouts[[0, 1, 2]])
    options = DataOptions(segment_length=200, initial_state="recorded")
    found = score(furuta, rollouts[[3, 4]], posterior.most_likely(2_000), options)
    assert found["rmse"].mean() < 0.446 and found["dtw"].mean() < 2240.0
    assert posterior.provenance.rounds[0].losses["implausible"] > 0
    # With the data sheet's motor the arm would have to be heavier than the prior allows.
    with pytest.raises(BackendError, match="None of 20000 draws"):
        regress(furuta, rollouts[[0, 1, 2]], undetermined="nominal")


@pytest.mark.skipif(not EMPS.exists(), reason=f"the recording {EMPS} is absent")
def test_the_real_positioning_drive_has_the_published_parameters():
    model = zoo()["emps"].model
    for effect in (CoulombFriction("carriage"), Bias("carriage")):
        model = npdr.add_effect(model, effect)
    draws = regress(model, Rollouts.from_csv(EMPS)).sample(1_000)
    published = {
        "mass": 95.1,
        "viscous_friction": 203.5,
        "carriage.coulomb_friction.magnitude": 20.4,
        "carriage.bias.offset": 3.2,
    }
    for name, value in published.items():
        assert float(draws[name].double().mean()) == pytest.approx(value, rel=0.05), name
