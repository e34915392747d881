"""Priors of independent scalars, evaluated with and without runs of their program."""

import pyro
import pyro.distributions as dist
import pytest
import torch

from npdr_ppl.language.prior import Prior


def independent():
    pyro.sample("normal", dist.Normal(1.0, 0.3))
    pyro.sample("positive", dist.HalfNormal(0.2))
    pyro.sample("factor", dist.LogNormal(0.0, 0.5))
    pyro.sample("range", dist.Uniform(-1.0, 2.0))
    pyro.sample("gamma", dist.Gamma(2.0, 3.0))
    pyro.sample("share", dist.Beta(2.0, 3.0))
    pyro.sample("exact", dist.Normal(torch.tensor(0.0).double(), torch.tensor(1.0).double()))


def smooth():
    pyro.sample("normal", dist.Normal(1.0, 0.3))
    pyro.sample("positive", dist.HalfNormal(0.2))
    pyro.sample("range", dist.Uniform(-1.0, 2.0))


def dependent():
    mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
    pyro.sample("child", dist.Normal(mean, 1.0))


def dependent_by_kind():
    sign = pyro.sample("sign", dist.Normal(0.0, 1.0))
    pyro.sample("child", dist.Uniform(torch.where(sign > 0.0, -1.0, 0.0), 1.0))


def dependent_support():
    least = pyro.sample("least", dist.Normal(0.0, 1.0))
    pyro.sample("child", dist.Uniform(least, least + 1.0))


def dependent_far_away():
    first = pyro.sample("first", dist.Normal(0.0, 1.0))
    pyro.sample("child", dist.Normal(torch.relu(first - 3.5), 0.1))


def vector():
    pyro.sample("mean", dist.Normal(torch.zeros(2), 1.0).to_event(1))


def in_a_plate():
    with pyro.plate("joints", 2):
        pyro.sample("friction", dist.HalfNormal(1.0))


def not_normal():
    pyro.sample("angle", dist.VonMises(0.0, 2.0))


def learnable():
    scale = pyro.param("scale", torch.tensor(1.0))
    pyro.sample("mean", dist.Normal(0.0, scale))


@pytest.fixture
def both(monkeypatch):
    """Returns the results of a function of a prior: by the sites alone, and by the program."""

    def results(model, function):
        alone, by_program = Prior(model), Prior(model)
        assert alone._independent is not None
        by_program.__dict__["_independent"] = None
        return function(alone), function(by_program)

    return results


def points(prior, number=200):
    generator = torch.Generator().manual_seed(1)
    return 3.0 * torch.randn(number, prior.num_parameters, generator=generator).double()


def test_parameters_and_coordinates_are_those_of_the_program(both):
    own, wanted = both(independent, lambda prior: prior.to_parameters(points(prior)))
    assert own.keys() == wanted.keys()
    for name, value in wanted.items():
        assert own[name].dtype == value.dtype
        assert torch.equal(own[name], value), name
    z, wanted = both(independent, lambda prior: prior.to_reference(own))
    assert z.dtype == wanted.dtype and torch.equal(z, wanted)


def test_densities_are_those_of_the_program(both):
    for density in (Prior.log_prob, Prior.log_prob_parameters, Prior.log_jacobian):
        own, wanted = both(independent, lambda prior, f=density: f(prior, points(prior)))
        assert own.dtype == wanted.dtype
        assert own == pytest.approx(wanted.numpy(), rel=1e-6)


def test_the_support_is_that_of_the_program(both):
    def inside(prior):
        values = prior.to_parameters(points(prior, 6))
        values["range"][0], values["positive"][1] = 3.0, -0.1
        values["normal"][2], values["exact"][3] = torch.nan, torch.inf
        return prior.on_support(values)

    own, wanted = both(independent, inside)
    assert own.tolist() == wanted.tolist() == [False] * 4 + [True] * 2


def test_values_are_not_validated(both):
    """Off the support, densities are −∞ or NaN, and no error."""
    own, wanted = both(smooth, lambda prior: prior.log_prob_parameters(torch.full((2, 3), 1e3)))
    assert own.tolist() == wanted.tolist()


def test_coordinates_can_be_differentiated(both):
    def slope(prior):
        z = points(prior, 3).requires_grad_()
        sum(v.double().sum() for v in prior.to_parameters(z).values()).backward()
        return z.grad

    own, wanted = both(smooth, slope)
    assert own == pytest.approx(wanted.numpy(), rel=1e-6)


OTHERS = [
    dependent, dependent_by_kind, dependent_support, dependent_far_away, vector, in_a_plate,
    not_normal, learnable,
]  # fmt: skip


@pytest.mark.parametrize("model", OTHERS, ids=lambda model: model.__name__)
def test_other_programs_are_run(model):
    pyro.clear_param_store()
    assert Prior(model)._independent is None
