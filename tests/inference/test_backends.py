"""What every registered backend must do, on a linear-Gaussian problem with a known posterior."""

import dataclasses
import json
import math

import pytest
import safetensors.torch
import torch

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend, backend_class, backends
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.randomness import seeded

GAIN = torch.tensor([[1.0, 0.5], [0.0, 1.0], [0.3, -0.6]])
NOISE = 0.5
OBSERVATION = torch.tensor([0.6, -0.4, 0.7])

NUM_SIMULATIONS = 3000
NUM_SAMPLES = 10_000

FALSE_ALARM = 4.5
"""Standard errors: of some twenty comparisons one fails by chance once in 7000 runs."""

TRAINING_TOLERANCE = 0.1
"""Error granted to learning from 3000 simulations, in posterior standard deviations."""

NUM_CHAIN_DRAWS = 500
"""Of each of two chains: as many as leave a sampler no larger an error than learning has."""


@pytest.fixture(params=sorted(backends()))
def method(request):
    if request.param == "nuts":
        return backend("nuts", chains=2, num_samples=NUM_CHAIN_DRAWS, warmup=100)
    return backend(request.param)


@pytest.fixture
def brief(method):
    """The same for tests of manners, for which a few draws of a slow sampler will do."""
    if method.name == "nuts":
        return dataclasses.replace(method, num_samples=20, warmup=20)
    return method


def little_trained(method):
    """The same after a few epochs, for tests for which it does not matter what was learned."""
    if hasattr(method, "epochs"):
        return dataclasses.replace(method, epochs=5)
    return method


@pytest.fixture(
    params=[name for name in sorted(backends()) if backend_class(name).uses_simulations]
)
def simulation_based(request):
    return backend(request.param)


def simulate(z):
    return z @ GAIN.T + NOISE * torch.randn(len(z), 3)


def regression_of(observation):
    """The same problem as a regression: z itself are the base parameters."""
    return LinearRegression(
        regressors=GAIN.double(),
        targets=observation.double(),
        names=("first", "second"),
        prior_mean=torch.zeros(2, dtype=torch.float64),
        prior_covariance=torch.eye(2, dtype=torch.float64),
        determined=torch.ones(2, dtype=torch.bool),
        nominal=torch.zeros(2, dtype=torch.float64),
        to_reference=lambda base, z: (base, torch.ones(len(base), dtype=torch.bool)),
        from_reference=lambda z: z,
        noise=NOISE,
    )


def make_problem(device="cpu", observation=OBSERVATION):
    normal = torch.distributions.Normal(0.0, 1.0)
    return Problem(
        num_parameters=2,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, 2),
        log_prior=lambda z: normal.log_prob(z).sum(-1),
        device=torch.device(device),
        regression=lambda smoothing: regression_of(observation),
        log_likelihood=lambda z: (
            -0.5 * ((observation - z @ GAIN.T.to(z)) / NOISE).square().sum(-1)
        ),
    )


def run_round(method, problem, state, number, fail=0.0, n=NUM_SIMULATIONS):
    with seeded(7, "round", number):
        z = method.ask(problem, state, n)
        x = simulate(z)
        x[torch.rand(len(z)) < fail] = math.nan
        return method.tell(problem, state, z, x)


def draws(method, problem, state, n=NUM_SAMPLES):
    with seeded(7, "draws"):
        return Mixture(method.densities(problem, state)).sample(n)


def assert_exact_moments(z, *, num_independent=None, learning=TRAINING_TOLERANCE):
    """Compares with the posterior from the joint Gaussian's precision."""
    n = num_independent or len(z)
    precision = torch.eye(2) + GAIN.T @ GAIN / NOISE**2
    covariance = precision.inverse()
    mean = covariance @ GAIN.T @ OBSERVATION / NOISE**2
    sd = covariance.diagonal().sqrt()
    assert ((z.mean(0) - mean).abs() < sd * (FALSE_ALARM / n**0.5 + learning)).all()
    # Var of a sample covariance of a Gaussian: (C_ii C_jj + C_ij^2) / n <= 2 C_ii C_jj / n.
    limit = torch.outer(sd, sd) * (FALSE_ALARM * (2 / n) ** 0.5 + 2 * learning + learning**2)
    assert ((z.T.cov() - covariance).abs() < limit).all()


@pytest.mark.slow
def test_recovers_a_linear_gaussian_posterior_in_every_round(method):
    problem = make_problem()
    state = method.init(problem)
    # A sampler learns nothing from simulations: it has only its own draws' error, in any round.
    learns = method.uses_simulations
    exactness = {} if learns else {"num_independent": 2 * NUM_CHAIN_DRAWS, "learning": 0.0}
    for number in range(2 if learns else 1):
        state, info = run_round(method, problem, state, number)
        assert info.num_simulations == (NUM_SIMULATIONS if learns else 0)
        assert info.num_failed == 0
        assert state.round == number + 1
        assert_exact_moments(draws(method, problem, state), **exactness)


@pytest.mark.slow
def test_density_is_normalised_and_fits_its_samples(method):
    problem = make_problem()
    state, _ = run_round(method, problem, method.init(problem), 0, n=500)
    for density in method.densities(problem, state):
        with seeded(3):
            z = density.sample(5000)
        assert z.shape == (5000, 2)
        # Importance sampling of the integral of q over a wide normal that covers the samples.
        wide = torch.distributions.MultivariateNormal(z.mean(0), 4 * z.T.cov())
        with seeded(4), torch.no_grad():
            points = wide.sample((20_000,))
            ratio = (density.log_prob(points) - wide.log_prob(points)).exp()
        error = ratio.std() / len(ratio) ** 0.5
        assert abs(ratio.mean() - 1) < FALSE_ALARM * error
        # The same integral of z q(z) is the samples' mean; a sampler's draws come up repeatedly.
        first = (ratio[:, None] * points).mean(0)
        num_distinct = len(z.unique(dim=0))
        error = (ratio[:, None] * points).std(0) / len(ratio) ** 0.5
        error = error + z.std(0) / num_distinct**0.5
        assert ((first - z.mean(0)).abs() < FALSE_ALARM * error).all()


def test_log_prob_is_differentiable(brief):
    brief = little_trained(brief)
    problem = make_problem()
    state, _ = run_round(brief, problem, brief.init(problem), 0, n=200)
    z = torch.zeros(3, 2, requires_grad=True)
    (gradient,) = torch.autograd.grad(brief.densities(problem, state)[0].log_prob(z).sum(), z)
    assert gradient.isfinite().all() and gradient.abs().sum() > 0


@pytest.mark.slow
def test_same_seed_same_result_also_after_resumption(brief, tmp_path):
    brief = little_trained(brief)
    problem = make_problem()
    state, _ = run_round(brief, problem, brief.init(problem), 0, n=200)
    again, _ = run_round(brief, problem, brief.init(problem), 0, n=200)
    assert torch.equal(draws(brief, problem, state, 500), draws(brief, problem, again, 500))

    tensors, values = brief.tensors(state)
    safetensors.torch.save_file(tensors, tmp_path / "state.safetensors")
    tensors = safetensors.torch.load_file(tmp_path / "state.safetensors")
    restored = brief.restore(problem, tensors, json.loads(json.dumps(values)))
    assert torch.equal(draws(brief, problem, state, 500), draws(brief, problem, restored, 500))

    state, _ = run_round(brief, problem, state, 1, n=200)
    restored, _ = run_round(brief, problem, restored, 1, n=200)
    assert restored.round == 2
    assert torch.equal(draws(brief, problem, state, 500), draws(brief, problem, restored, 500))


def test_initial_state_survives_writing(brief):
    brief = little_trained(brief)
    problem = make_problem()
    tensors, values = brief.tensors(brief.init(problem))
    restored = brief.restore(problem, tensors, json.loads(json.dumps(values)))
    state, _ = run_round(brief, problem, restored, 0, n=200)
    assert state.round == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in sorted(backends()) if backend_class(n).amortises])
def test_amortised_states_hold_at_every_observation(name):
    method = little_trained(backend(name))
    problem = make_problem()
    state, _ = run_round(method, problem, method.init(problem), 0, n=300)
    observations = torch.stack((OBSERVATION, -OBSERVATION, torch.zeros(3)))
    z = torch.linspace(-1, 1, 10).reshape(5, 2)
    given = list(method.densities_given(problem, state, observations))
    assert len(given) == len(observations)
    for x, members in zip(observations, given, strict=True):
        alone = method.densities(make_problem(observation=x), state)
        assert len(members) == len(alone)
        for one, other in zip(members, alone, strict=True):
            with torch.no_grad():
                assert torch.equal(one.log_prob(z), other.log_prob(z))
            with seeded(1):
                draws = one.sample(5)
            with seeded(1):
                assert torch.equal(other.sample(5), draws)


def test_drops_failed_simulations(simulation_based):
    problem = make_problem()
    state, info = run_round(simulation_based, problem, simulation_based.init(problem), 0, fail=0.2)
    error = (0.2 * 0.8 * NUM_SIMULATIONS) ** 0.5
    assert abs(info.num_failed - 0.2 * NUM_SIMULATIONS) < FALSE_ALARM * error
    assert_exact_moments(draws(simulation_based, problem, state))


def test_refuses_when_all_simulations_failed(simulation_based):
    problem = make_problem()
    with pytest.raises(BackendError, match="100 of 100 simulations failed"):
        simulation_based.tell(
            problem,
            simulation_based.init(problem),
            torch.randn(100, 2),
            torch.full((100, 3), math.inf),
        )


@pytest.mark.parametrize(
    ("z_shape", "x_shape"),
    [((50, 3), (50, 3)), ((50, 2), (50, 4)), ((50, 2), (40, 3)), ((2,), (3,))],
)
def test_refuses_bad_shapes(method, z_shape, x_shape):
    problem = make_problem()
    with pytest.raises(ShapeError, match="must have shape"):
        method.tell(problem, method.init(problem), torch.randn(z_shape), torch.randn(x_shape))


def test_refuses_an_observation_that_is_not_finite(method):
    with pytest.raises(BackendError, match="1 of 3 features"):
        method.init(make_problem(observation=torch.tensor([0.0, math.nan, 1.0])))


def test_has_no_posterior_before_the_first_round(method):
    problem = make_problem()
    with pytest.raises(BackendError, match="no posterior yet"):
        method.densities(problem, method.init(problem))


@pytest.mark.slow
def test_stays_finite_far_from_the_simulations(brief):
    problem = make_problem(observation=torch.tensor([1e6, -1e9, 0.0]))
    state, _ = run_round(brief, problem, brief.init(problem), 0, n=200)
    z = draws(brief, problem, state, 2000)
    assert z.isfinite().all()
    state, _ = run_round(brief, problem, state, 1, n=200)
    assert draws(brief, problem, state, 2000).isfinite().all()


def test_leaves_the_callers_random_stream_to_the_caller(brief):
    brief = little_trained(brief)
    problem = make_problem()
    state, _ = run_round(brief, problem, brief.init(problem), 0, n=200)
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    brief.densities(problem, state)
    assert torch.equal(torch.rand(3), expected)


def test_reports_progress(brief):
    brief = little_trained(brief)
    problem, seen = make_problem(), []
    with seeded(0):
        z = torch.randn(200, 2)
        brief.tell(
            problem,
            brief.init(problem),
            z,
            simulate(z),
            lambda done, text: seen.append((done, text)),
        )
    fractions = [done for done, _ in seen]
    assert fractions and fractions == sorted(fractions) and fractions[-1] <= 1
    assert all(text for _, text in seen)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_trains_on_the_problems_device(simulation_based):
    problem = make_problem("cuda")
    state, _ = run_round(simulation_based, problem, simulation_based.init(problem), 0)
    assert torch.cuda.max_memory_allocated() > 0
    z = draws(simulation_based, problem, state)
    assert z.device.type == "cpu"
    assert_exact_moments(z)
