"""Reference coordinates: bijective, standard normal, with the right density."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

import npdr_ppl as npdr
from npdr_ppl.errors import ModelError
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.reference import reference_map


def total(**parameters):
    return sum(value.reshape(value.shape[0], -1).sum(-1) for value in parameters.values())


def bounded():
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    length = pyro.sample("length", dist.Beta(2.0, 3.0))
    npdr.simulate("x", total, {"mass": mass, "length": length})


def dependent():
    scale = pyro.sample("scale", dist.HalfNormal(2.0))
    mass = pyro.sample("mass", dist.LogNormal(torch.log(scale), 0.2))
    rate = pyro.sample("rate", dist.Gamma(2.0, mass))
    inverse = pyro.sample("inverse", dist.InverseGamma(3.0, 1.0))
    npdr.simulate("x", total, {"mass": mass, "rate": rate, "inverse": inverse})


def correlated():
    factor = torch.tensor([[1.0, 0.0], [0.5, 1.0]])
    pair = pyro.sample("pair", dist.MultivariateNormal(torch.ones(2), scale_tril=factor))
    base = dist.Normal(torch.zeros(2), 1.0).to_event(1)
    transforms = [
        dist.transforms.LowerCholeskyAffine(torch.zeros(2), factor),
        dist.transforms.ExpTransform(),
    ]
    positive = pyro.sample("positive", dist.TransformedDistribution(base, transforms))
    npdr.simulate("x", total, {"pair": pair, "positive": positive})


def fleet():
    mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
    spread = pyro.sample("spread", dist.HalfNormal(1.0))
    with pyro.plate("rigs", 3):
        own = pyro.sample("own", dist.LogNormal(mean, spread))
        pair = pyro.sample("pair", dist.Uniform(-1.0, 1.0).expand([2]).to_event(1))
        npdr.simulate(
            "x", lambda own, pair: torch.cat([own[:, None], pair], -1), {"own": own, "pair": pair}
        )


def unconstrained_only():
    angle = pyro.sample("angle", dist.VonMises(0.0, 1.0))
    share = pyro.sample("share", dist.Dirichlet(torch.ones(3)))
    heavy = pyro.sample("heavy", dist.StudentT(4.0, 0.0, 1.0))
    npdr.simulate("x", total, {"angle": angle, "share": share, "heavy": heavy})


PROGRAMS = [bounded, dependent, correlated, fleet, unconstrained_only]


@pytest.mark.parametrize("program", PROGRAMS)
def test_coordinates_and_parameters_are_inverse_to_each_other(program):
    prior = Prior(program)
    torch.manual_seed(0)
    z = prior.sample(50)
    parameters = prior.to_parameters(z)
    for site in prior.sites:
        assert parameters[site.name].shape == (50, *site.shape)
    # Parameters are float32, as the programs sample them.
    torch.testing.assert_close(prior.to_reference(parameters), z, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("program", PROGRAMS[:-1])
def test_the_programs_own_draws_are_standard_normal_in_the_coordinates(program):
    prior = Prior(program)
    assert prior.is_standard_normal
    pyro.set_rng_seed(0)
    draws = pyro.infer.Predictive(program, num_samples=2_000, parallel=True)()
    z = prior.to_reference(
        {s.name: draws[s.name].reshape(2_000, *s.shape) for s in prior.sites}
    ).numpy()
    # False alarms: at most one test in a thousand over all coordinates of all programs.
    level = 1e-3 / 30
    for column in z.T:
        assert stats.kstest(column, "norm").pvalue > level
    for program_column in range(z.shape[1] - 1):
        result = stats.pearsonr(z[:, program_column], z[:, program_column + 1])
        assert result.pvalue > level


@pytest.mark.parametrize("program", [bounded, dependent, correlated, fleet])
def test_jacobian_matches_finite_differences(program):
    prior = Prior(program)
    torch.manual_seed(1)
    z = 0.5 * torch.randn(1, prior.num_parameters, dtype=torch.float64)

    def parameters(z):
        values = prior.to_parameters(z)
        return torch.cat([values[s.name].reshape(len(z), -1) for s in prior.sites], -1).double()

    step = 2e-2  # wide, because the parameters are float32; the curvature cancels in the middle
    unit = torch.eye(prior.num_parameters, dtype=torch.float64)
    jacobian = (parameters(z + step * unit) - parameters(z - step * unit)) / (2 * step)
    numeric = torch.linalg.slogdet(jacobian).logabsdet
    assert abs(prior.log_jacobian(z).item() - numeric.item()) < 0.02


def test_density_without_quantiles_is_the_distributions_own():
    prior = Prior(unconstrained_only)
    assert not prior.is_standard_normal
    torch.manual_seed(0)
    z = prior.sample(4_000)
    # The density over z integrates to one: importance sampling from a wide normal.
    wide = torch.distributions.Normal(0.0, 2.5)
    points = wide.sample((20_000, prior.num_parameters)).double()
    weights = (prior.log_prob(points) - wide.log_prob(points).sum(-1)).exp()
    error = weights.std() / len(weights) ** 0.5
    assert abs(weights.mean() - 1) < 4 * error
    assert z.shape == (4_000, 4)


def test_no_point_is_implausible():
    prior = Prior(bounded)
    far = torch.tensor([[50.0, -50.0], [-50.0, 50.0]])
    parameters = prior.to_parameters(far)
    assert bool(((parameters["mass"] >= 0.3) & (parameters["mass"] <= 1.7)).all())
    assert bool(((parameters["length"] >= 0) & (parameters["length"] <= 1)).all())


@pytest.mark.parametrize("program", PROGRAMS)
def test_draws_lie_on_the_support_and_spoilt_ones_do_not(program):
    prior = Prior(program)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        values = prior.to_parameters(prior.sample(20))
    assert prior.on_support(values).all()
    for site in prior.sites:
        for spoilt in (torch.nan, torch.inf):
            changed = {name: value.clone() for name, value in values.items()}
            changed[site.name].view(20, -1)[3, -1] = spoilt
            assert prior.on_support(changed).tolist() == [row != 3 for row in range(20)]


def test_values_off_the_support_are_told_also_where_others_depend_on_them():
    prior = Prior(dependent)
    values = {site.name: torch.ones(4) for site in prior.sites}
    values["scale"] = torch.tensor([1.0, -1.0, 1.0, 1.0])
    values["mass"] = torch.tensor([1.0, 1.0, -2.0, 1.0])
    values["rate"] = torch.tensor([1.0, 1.0, 1.0, -1.0])
    assert prior.on_support(values).tolist() == [True, False, False, False]


def test_execution_is_batched_and_keeps_plates():
    prior = Prior(fleet)
    torch.manual_seed(0)
    z = prior.sample(7)
    outputs = prior.execute(z)["x"]
    assert outputs.shape == (7, 3, 3)
    parameters = prior.to_parameters(z)
    torch.testing.assert_close(outputs[..., 0], parameters["own"])
    torch.testing.assert_close(prior.execute_at(parameters)["x"], outputs)


def test_discrete_sites_are_refused():
    def model():
        count = pyro.sample("count", dist.Poisson(2.0))
        npdr.simulate("x", total, {"count": count})

    with pytest.raises(ModelError, match=r"'count' is discrete \(Poisson\)"):
        Prior(model)


def test_ordinary_likelihoods_are_refused_unless_they_are_constant():
    def model(depends):
        mass = pyro.sample("mass", dist.Normal(0.0, 1.0))
        loc = mass if depends else torch.zeros(())
        pyro.sample("y", dist.Normal(loc, 1.0), obs=torch.tensor(1.0))
        npdr.simulate("x", total, {"mass": mass})

    with pytest.raises(ModelError, match="'y' is observed and depends on latent sites"):
        Prior(model, (True,))
    assert Prior(model, (False,)).num_parameters == 1


def test_a_conditioned_site_is_not_latent():
    prior = Prior(pyro.condition(bounded, data={"mass": torch.tensor(1.0)}))
    assert [site.name for site in prior.sites] == ["length"]


def test_nothing_to_infer_is_said():
    with pytest.raises(ModelError, match="nothing to infer"):
        Prior(lambda: npdr.simulate("x", total, {"mass": torch.ones(())}))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_far_in_a_tail_are_finite(dtype):
    z = torch.tensor([-8.0, -5.5, 5.5, 8.0], dtype=dtype)
    for distribution in (
        dist.HalfNormal(1e-3), dist.Exponential(2.0), dist.Gamma(2.0, 3.0), dist.Cauchy(0.0, 1.0),
    ):  # fmt: skip
        values = reference_map(distribution)(z)
        assert values.dtype == dtype and values.isfinite().all()
        assert (values.diff() > 0).all()
        assert reference_map(distribution)(100.0 * z).isfinite().all()
