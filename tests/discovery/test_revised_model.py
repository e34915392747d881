"""The source code of a revised model is a model with the same effects, steps and priors."""

import runpy

import pyro.distributions as dist
import pytest
from torch.distributions import AffineTransform

import npdr_ppl as npdr
from npdr_ppl.discovery.revised_model import revised_source
from npdr_ppl.language.handlers import num_finer_steps
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.wider_priors import wider_sites
from npdr_ppl.models.effects import Bias, Cogging, QuadraticDrag
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.pendulum_recordings import swinging


def test_the_revised_source_is_a_model_with_the_effects(tmp_path):
    source = revised_source(pendulum, (QuadraticDrag("hinge"), Bias("hinge")), {"mass": 1.0})
    path = tmp_path / "revised_model.py"
    path.write_text(source)
    model = runpy.run_path(str(path))["revised_model"]
    assert [effect.name for effect, _ in model.effects] == ["hinge.quadratic_drag", "hinge.bias"]


def test_names_of_sites_do_not_become_code_of_the_revised_source(tmp_path):
    site = 'hinge": 0}\nraise SystemExit("ran")\n{"\\'
    path = tmp_path / "revised_model.py"
    path.write_text(revised_source(pendulum, (), {site: 1.0}))
    assert runpy.run_path(str(path))["CLOSEST_FIT"] == {site: 1.0}


def test_the_revised_source_keeps_finer_steps(tmp_path):
    path = tmp_path / "revised_model.py"
    finest = npdr.with_finer_steps(npdr.with_finer_steps(pendulum))
    path.write_text(revised_source(finest, (Bias("hinge"),), {}))
    model = runpy.run_path(str(path))["revised_model"]
    assert repr(model) == "pendulum + hinge.bias"
    assert repr(model.base) == "pendulum in still finer steps"


def test_the_revised_source_keeps_handlers_inside_each_other(tmp_path):
    own = npdr.with_wider_priors(npdr.add_effect(pendulum, Bias("hinge")), ["length"])
    path = tmp_path / "revised_model.py"
    path.write_text(
        revised_source(npdr.with_finer_steps(own), (QuadraticDrag("hinge"),), {"mass": 1.0})
    )
    model = runpy.run_path(str(path))["revised_model"]
    assert wider_sites(model) == [["length"]] and num_finer_steps(model) == 1
    rollouts = swinging()
    names = Prior(model, (rollouts.inputs(50, "recorded"),)).distributions
    assert {"hinge.bias.offset", "hinge.quadratic_drag.drag", "length", "mass"} <= set(names)


def test_the_revised_source_keeps_priors_that_were_given(tmp_path):
    path = tmp_path / "revised_model.py"
    drag = QuadraticDrag("hinge", priors={"drag": dist.LogNormal(-3.0, 0.1)})
    shifted = dist.TransformedDistribution(dist.Normal(0.0, 1.0), [AffineTransform(0.3, 0.1)])
    bias = Bias("hinge", priors={"offset": shifted})
    cogging = Cogging("hinge", order=7, priors={"sine": dist.Normal(0.1, 0.2)})
    path.write_text(revised_source(pendulum, (drag, bias, cogging), {}))
    model = runpy.run_path(str(path))["revised_model"]
    (found, _), (other, _), (ripple, _) = model.effects
    assert ripple.order == 7 and list(ripple.given_priors) == ["sine"]
    prior = found.given_priors["drag"]
    assert (type(prior), float(prior.loc), float(prior.scale)) == (
        dist.LogNormal, -3.0, pytest.approx(0.1)
    )  # fmt: skip
    # Transforms of one's own have no source. The file says so and still is a model.
    assert not other.given_priors
    assert "# The prior given to hinge.bias.offset has no source: put it here." in path.read_text()
