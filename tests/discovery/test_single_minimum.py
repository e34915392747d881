"""A search of the whole prior is left out only where the misfit has one minimum."""

import pyro
import pyro.distributions as dist
import torch

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search import base_fit
from npdr_ppl.discovery.search.base_fit import fit_base
from npdr_ppl.discovery.search.single_minimum import has_single_minimum
from npdr_ppl.language.sites import simulate
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging

PENDULUM = Pendulum(integrator="rk4")


def damped(inputs):
    """Of a pendulum whose mass and length are known, motion is nearly linear in the damping."""
    mass, damping = pyro.sample("mass", dist.Uniform(1.09, 1.11)), dist.Uniform(0.0, 0.05)
    given = {"mass": mass, "length": 0.9, "damping": pyro.sample("damping", damping)}
    return simulate("motion", PENDULUM, given, inputs)


def free(inputs):
    """Of a pendulum of unknown length, frequency and with it the phase are unknown."""
    length, damping = pyro.sample("length", dist.Uniform(0.2, 2.0)), dist.Uniform(0.0, 0.05)
    given = {"mass": 1.1, "length": length, "damping": pyro.sample("damping", damping)}
    return simulate("motion", PENDULUM, given, inputs)


def segments(model):
    return SegmentModel(model, swinging(rollouts=2, steps=120), DataOptions(None, 40))


def test_only_a_nearly_linear_motion_has_a_single_minimum():
    assert has_single_minimum(segments(damped), seed=0)
    assert not has_single_minimum(segments(free), seed=0)


def test_a_model_whose_laws_have_local_minima_is_searched(monkeypatch):
    """Whatever the influence of the other parameters."""
    declared = property(lambda self: torch.tensor([False, True]))
    monkeypatch.setattr(SegmentModel, "coordinates_with_minima", declared)
    assert not has_single_minimum(segments(damped), seed=0)


def test_a_fit_with_a_single_minimum_ends_where_one_with_a_search_does(monkeypatch):
    searched = []
    search = base_fit.search_prior
    monkeypatch.setattr(
        base_fit, "search_prior", lambda *a, **k: searched.append(1) or search(*a, **k)
    )
    model = segments(damped)
    quick, _ = fit_base(model)
    assert not searched
    monkeypatch.setattr(base_fit, "has_single_minimum", lambda *a, **k: False)
    slow, _ = fit_base(model)
    assert searched
    assert isinstance(quick, Hypothesis)
    deviation = slow.likelihood.information().inverse().diagonal().sqrt()
    assert ((quick.fit.z - slow.fit.z).abs() < 0.1 * deviation).all()
    torch.testing.assert_close(quick.fit.scale, slow.fit.scale, rtol=1e-3, atol=0.0)
