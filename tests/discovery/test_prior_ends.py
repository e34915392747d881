"""Priors that end too early: which parameters are beyond their ends, and what is said of them."""

import math
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search.original_model import OriginalModel
from npdr_ppl.discovery.search.prior_ends import (
    PriorEnd,
    beyond,
    widen_where_it_helps,
)
from npdr_ppl.discovery.search.settings import PRIOR_ENDS
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.language.handlers import num_finer_steps, with_finer_steps
from npdr_ppl.language.wider_priors import wider_sites, with_wider_priors
from npdr_ppl.models.effects import Bias, CoulombFriction
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import TRUTH, swinging, too_short


def ends(prior, value):
    """Returns the end of a prior beyond which a fitted value is, ``None`` if it is inside."""
    found = beyond({"x": prior}, SimpleNamespace(parameters={"x": torch.tensor(value)}))
    assert len(found) <= 1
    return found[0].end if found else None


@pytest.mark.parametrize(
    ("prior", "inside", "lower", "upper"),
    [
        (dist.Uniform(0.3, 1.7), (0.31, 1.0, 1.69), (0.3, 0.1, -2.0), (1.7, 1.8, 40.0)),
        (dist.Uniform(-2.0, -1.0), (-1.9, -1.1), (-2.0, -2.5), (-1.0, -0.5, 1.0)),
        # One in a thousand is 3.09 standard deviations above or below the mean.
        (dist.Normal(1.0, 0.5), (1.0, -0.5, 2.5), (-0.6, -20.0), (2.6, 40.0)),
        (dist.LogNormal(0.0, 0.5), (1.0, 0.22, 4.6), (0.2, 0.05), (4.8, 20.0)),
        # One in a thousand is 3.29 scales from zero. No strength is less than zero.
        (dist.HalfNormal(2.0), (0.0, 1e-4, 0.1, 6.5), (), (6.7, 20.0, 90.0)),
        (dist.Uniform(0.0, 1.0), (0.0, 1e-4, 0.9), (), (1.0, 2.0)),
        (dist.Exponential(1.0), (0.0, 1e-4, 1.0, 6.8), (), (7.0,)),
    ],
)
def test_a_value_is_beyond_an_end_if_its_prior_has_hardly_any_mass_there(
    prior, inside, lower, upper
):
    assert [ends(prior, value) for value in inside] == [None] * len(inside)
    assert [ends(prior, value) for value in lower] == ["lower"] * len(lower)
    assert [ends(prior, value) for value in upper] == ["upper"] * len(upper)


def test_the_ends_are_listed_by_parameter_with_prior_and_value():
    priors = {
        "mass": dist.Uniform(0.3, 1.7), "length": dist.Uniform(0.3, 0.75),
        "damping": dist.LogNormal(-3.0, 0.5),
    }  # fmt: skip
    values = {"mass": 1.0, "length": 0.9, "damping": 1e-3, "hinge.bias.torque": 100.0}
    parameters = {name: torch.tensor(value) for name, value in values.items()}
    # The parameter of an added effect is no prior of the model.
    found = beyond(priors, SimpleNamespace(parameters=parameters))
    assert found == (
        PriorEnd("length", "upper", "Uniform(0.3, 0.75)", pytest.approx(0.9)),
        PriorEnd("damping", "lower", "LogNormal(-3, 0.5)", pytest.approx(1e-3)),
    )


def test_parameters_without_one_value_or_quantiles_are_left_out():
    priors = {
        "pair": dist.Uniform(0.0, 1.0).expand([2]),
        "angle": dist.VonMises(0.0, 1.0),
        "shape": dist.Beta(2.0, 2.0),
    }
    parameters = {
        "pair": torch.tensor([5.0, 5.0]), "angle": torch.tensor(3.1), "shape": torch.tensor(0.999),
    }  # fmt: skip
    assert beyond(priors, SimpleNamespace(parameters=parameters)) == ()


def test_a_prior_of_one_element_counts_as_a_scalar():
    priors = {"x": dist.Uniform(0.0, 1.0).expand([1])}
    (end,) = beyond(priors, SimpleNamespace(parameters={"x": torch.tensor([1.5])}))
    assert (end.name, end.end, end.closest) == ("x", "upper", 1.5)


def test_an_end_is_said_in_one_sentence_with_what_to_do():
    end = PriorEnd("length", "upper", "Uniform(0.3, 0.75)", 0.89957)
    assert str(end) == (
        "length fits best at about 0.8996 with wider priors, at or beyond the upper end of its "
        "prior, Uniform(0.3, 0.75): widen the prior"
    )


@pytest.fixture(scope="module")
def recording():
    return swinging(rollouts=1, steps=160)


def fitted(model, recording, **kwargs):
    return fit_hypothesis(model, recording, segment_options(recording), **kwargs)


def test_a_prior_that_excludes_the_fit_is_widened(recording):
    def model(inputs):
        pyro.sample("idle", dist.Uniform(0.0, 1.0))
        return too_short(inputs)

    current = fitted(model, recording)
    assert float(current.parameters["length"]) == pytest.approx(0.75, abs=0.01)
    found = widen_where_it_helps(current.segments, current)
    (end,) = found.ends
    assert (end.name, end.end, end.prior) == ("length", "upper", "Uniform(0.3, 0.75)")
    for name, value in TRUTH.items():
        assert float(found.hypothesis.parameters[name]) == pytest.approx(value, rel=0.05)
    assert end.closest == pytest.approx(float(found.hypothesis.parameters["length"]))
    priors = found.segments.prior.distributions
    assert float(priors["length"].high) == pytest.approx(0.75 + 0.45)
    # A parameter in the middle of its prior keeps it.
    assert float(priors["idle"].high) == 1.0


@pytest.mark.parametrize(("scale", "is_widened"), [(0.02, True), (0.2, False)])
def test_the_strength_of_an_effect_is_not_cut_off_by_its_prior(scale, is_widened):
    rubbed = swinging(rollouts=1, steps=160, friction=0.3)
    friction = CoulombFriction("hinge", priors={"magnitude": dist.HalfNormal(scale)})
    base = fitted(exact(1.7), rubbed)
    found = Trials(base.segments).refitted(base, (friction,))
    assert float(found.parameters[friction.parameter_names[0]]) == pytest.approx(0.3, rel=0.03)
    (own,) = found.effects
    widenings = math.log(float(own.given_priors["magnitude"].scale) / scale, 3.0)
    assert widenings == pytest.approx(round(widenings), abs=1e-6)
    assert 1 <= round(widenings) <= PRIOR_ENDS.most_widenings if is_widened else widenings < 0.1


def exact(longest):
    """Returns a pendulum with hardly any error of integration, and the prior's longest length."""

    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        length = pyro.sample("length", dist.Uniform(0.3, longest))
        parameters = {"mass": mass, "length": length}
        return npdr.simulate("trajectory", Pendulum(integrator="rk4"), parameters, inputs)

    return model


@pytest.mark.parametrize(("longest", "suffices"), [(1.7, True), (0.75, False)])
def test_widened_priors_are_given_up_where_the_models_own_suffice(recording, longest, suffices):
    model = with_finer_steps(exact(longest))
    original = OriginalModel(exact(longest), recording, segment_options(recording))
    wider = with_wider_priors(model, ["length"])
    original.base = SegmentModel(wider, recording, original.data_options)
    original.are_priors_widened = True
    current = original.trials.refitted(original.fit_base(), (Bias("hinge"),))
    assert original.take_own_priors(current) == suffices
    assert original.are_priors_widened != suffices
    wide = ["length"] if not suffices else []
    assert [name for names in wider_sites(original.base.model) for name in names] == wide
    assert num_finer_steps(original.base.model) == 1


def test_priors_that_contain_the_fit_or_end_within_its_error_are_left_as_they_are(recording):
    inside = fitted(exact(1.7), recording)
    assert widen_where_it_helps(inside.segments, inside) is None
    closest = float(inside.parameters["length"])
    at_end = fitted(exact(closest), recording)
    assert float(at_end.fit.z.abs().max()) > PRIOR_ENDS.near_coordinate
    assert widen_where_it_helps(at_end.segments, at_end) is None
    # One per cent less is many standard errors less.
    beyond_end = fitted(exact(0.99 * closest), recording)
    assert widen_where_it_helps(beyond_end.segments, beyond_end) is not None


def test_a_prior_is_left_as_it_is_if_the_fit_returns_into_it(recording):
    start = {"length": torch.tensor(1.69), "mass": torch.tensor(1.1)}
    current = fitted(pendulum, recording, start=start, max_steps=0)
    assert float(current.fit.z.abs().max()) > PRIOR_ENDS.near_coordinate
    assert widen_where_it_helps(current.segments, current) is None


@pytest.mark.parametrize(("end", "names"), [(0.99, ["length"]), (1.05, [])])
def test_a_prior_that_determines_a_parameter_is_said(recording, end, names):
    closest = float(fitted(exact(1.7), recording).parameters["length"])
    final = fitted(exact(end * closest), recording)
    found = beyond(final.segments.prior.distributions, final)
    assert [prior.name for prior in found] == names
    assert all("is at the upper end of its prior" in prior.decisive for prior in found)
