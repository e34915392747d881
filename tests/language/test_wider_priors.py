"""Wider priors: how far they reach, which sites have them, and how they are shown."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.distributions.torch_distribution import ExpandedDistribution

import npdr_ppl as npdr
from npdr_ppl.language.handlers import add_effect, with_finer_steps
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.wider_priors import (
    described_prior,
    widened,
    wider_sites,
    with_wider_priors,
)
from npdr_ppl.models.effects import CoulombFriction
from npdr_ppl.models.pendulum import pendulum

FIXED = [
    dist.Beta(2.0, 2.0),
    dist.Exponential(1.0),
    dist.Uniform(0.0, 1.0).expand([2]).to_event(1),
]
"""Priors that are not widened."""


def total(**parameters):
    return sum(value.reshape(value.shape[0], -1).sum(-1) for value in parameters.values())


def program():
    """A range, a scale, three rigs with ranges of their own, and a share."""
    parameters = {
        "length": pyro.sample("length", dist.Uniform(1.0, 2.0)),
        "offset": pyro.sample("offset", dist.Normal(0.5, 2.0)),
        "share": pyro.sample("share", dist.Beta(2.0, 2.0)),
    }
    pyro.sample("given", dist.Normal(0.0, 1.0), obs=torch.tensor(0.3))
    with pyro.plate("rigs", 3):
        parameters["own"] = pyro.sample("own", dist.Uniform(-1.0, 1.0))
    npdr.simulate("x", total, parameters)


def ends(prior):
    return float(prior.low), float(prior.high)


@pytest.mark.parametrize(
    ("ends_before", "ends_after"),
    [
        # By its own width at both ends.
        ((-1.0, 1.0), (-3.0, 3.0)),
        ((-0.5, 3.5), (-4.5, 7.5)),
        ((5.0, 6.0), (4.0, 7.0)),
        # A length stays positive, and a damping of zero or more stays so.
        ((0.3, 1.7), (0.03, 3.1)),
        ((0.0, 0.2), (0.0, 0.4)),
        ((-1.7, -0.3), (-3.1, -0.03)),
        ((-0.2, 0.0), (-0.4, 0.0)),
    ],
)
def test_a_range_grows_by_its_width_but_stays_on_its_side_of_zero(ends_before, ends_after):
    wider = widened(dist.Uniform(*ends_before))
    assert ends(wider) == pytest.approx(ends_after)


def test_each_range_of_several_grows_by_itself():
    wider = widened(dist.Uniform(torch.tensor([0.3, -1.0]), torch.tensor([1.7, 0.0])))
    torch.testing.assert_close(wider.low, torch.tensor([0.03, -2.0]))
    torch.testing.assert_close(wider.high, torch.tensor([3.1, 0.0]))


@pytest.mark.parametrize(
    "prior", [dist.Normal(2.0, 0.5), dist.HalfNormal(0.5), dist.LogNormal(-1.0, 0.5)]
)
def test_scales_become_three_times_as_large_about_the_same_centre(prior):
    wider = widened(prior)
    assert type(wider) is type(prior)
    share = torch.tensor([0.5, 0.84])
    # Of a log-normal distribution, the logarithm has the scale.
    before, after = (
        d.icdf(share).log() if isinstance(prior, dist.LogNormal) else d.icdf(share)
        for d in (prior, wider)
    )
    centre = 0.0 if isinstance(prior, dist.HalfNormal) else before[0]
    torch.testing.assert_close(after - centre, 3.0 * (before - centre))


def test_a_prior_that_pyro_has_expanded_keeps_its_shape():
    expanded = ExpandedDistribution(dist.Uniform(0.3, 1.7), torch.Size([3]))
    wider = widened(expanded)
    assert wider.batch_shape == (3,)
    assert float(wider.support.upper_bound.max()) == pytest.approx(3.1)
    assert described_prior(expanded) == "Uniform(0.3, 1.7)"
    assert widened(ExpandedDistribution(dist.Beta(2.0, 2.0), torch.Size([3]))) is None


@pytest.mark.parametrize("prior", FIXED)
def test_other_priors_are_not_widened(prior):
    assert widened(prior) is None


def test_only_the_named_latent_sites_have_wider_priors():
    names = ["length", "own", "share", "given", "absent"]
    before, after = (
        Prior(model).distributions for model in (program, with_wider_priors(program, names))
    )
    assert set(after) == set(before) == {"length", "offset", "share", "own"}
    assert ends(after["length"]) == (pytest.approx(0.1), pytest.approx(3.0))
    assert float(after["offset"].scale) == 2.0
    assert isinstance(after["share"], dist.Beta)
    assert float(after["share"].concentration1) == 2.0
    # Every rig has the wider range.
    own = pyro.poutine.trace(with_wider_priors(program, ["own"])).get_trace().nodes["own"]
    assert own["fn"].batch_shape == own["value"].shape == (3,)
    assert float(own["fn"].support.upper_bound.max()) == pytest.approx(3.0)
    assert float(own["fn"].support.lower_bound.min()) == pytest.approx(-3.0)


def test_a_conditioned_site_keeps_its_density():
    given = pyro.condition(program, data={"length": torch.tensor(1.5)})
    nodes = pyro.poutine.trace(with_wider_priors(given, ["length"])).get_trace().nodes
    assert ends(nodes["length"]["fn"]) == (1.0, 2.0)


def test_priors_that_are_widened_again_are_listed_in_order():
    once = with_wider_priors(program, ["length"])
    twice = with_wider_priors(once, ["length", "offset"])
    priors = Prior(twice).distributions
    # From 1 and 2 to 0.1 and 3, then by 2.9 at both ends, but not to zero.
    assert ends(priors["length"]) == (pytest.approx(0.01), pytest.approx(5.9))
    assert float(priors["offset"].scale) == pytest.approx(6.0)
    assert wider_sites(twice) == [["length"], ["length", "offset"]]
    assert wider_sites(program) == []
    # Applied in this order, they give the same priors again.
    again = program
    for names in wider_sites(twice):
        again = with_wider_priors(again, names)
    assert Prior(again).distributions.keys() == priors.keys()
    assert ends(Prior(again).distributions["length"]) == ends(priors["length"])


def test_sites_are_found_below_finer_steps_and_effects():
    wider = with_finer_steps(with_wider_priors(pendulum, ["length"]))
    changed = add_effect(with_wider_priors(wider, ["mass"]), CoulombFriction("hinge"))
    assert wider_sites(changed) == [["length"], ["mass"]]


def test_a_model_with_wider_priors_has_the_name_of_the_model_and_says_what_is_wider():
    wider = with_wider_priors(program, ["length", "own"])
    assert wider.__name__ == "program"
    assert wider.__doc__ == program.__doc__
    assert repr(wider) == "program with wider priors of length, own"


@pytest.mark.parametrize(
    ("prior", "text"),
    [
        (dist.Uniform(0.3, 1.7), "Uniform(0.3, 1.7)"),
        (dist.HalfNormal(0.123456), "HalfNormal(0.1235)"),
        (dist.Normal(-2.0, 1e-5), "Normal(-2, 1e-05)"),
        (dist.LogNormal(-1.0, 0.5), "LogNormal(-1, 0.5)"),
        (dist.Beta(2.0, 3.0), "Beta"),
        (dist.Uniform(torch.tensor([0.0, 1.0]), 2.0), "Uniform(…, …)"),
    ],
)
def test_priors_are_shown_with_their_numbers(prior, text):
    assert described_prior(prior) == text
