"""The features that inference uses if its user chooses none."""

from dataclasses import replace

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.pendulum_recordings import swinging


@pytest.fixture(scope="module")
def recording():
    return swinging(rollouts=1, steps=160)


def test_default_features_are_the_score_at_the_closest_fit(recording):
    posterior = npdr.infer(
        pendulum, recording, backend=backend("abc"), num_simulations=40, corrects=False,
        progress=False,
    )  # fmt: skip
    preparation = posterior.preparation
    assert preparation.summary.to_dict()["embedding"] == "Score(2 parameters)"
    # One number for each parameter, near zero, because the recording's likelihood is greatest at
    # the closest fit; simulations of other parameters are many standard deviations away.
    observed = posterior.bound.observed_features()
    assert observed.shape == (2,)
    assert float(observed.abs().max()) < 0.5
    torch.manual_seed(0)
    z = torch.stack((preparation.likelihood.fit.z, torch.zeros(2)))
    closest, nominal = posterior.bound.features(posterior.bound.prior.execute(z)).sinh()
    assert float(closest.abs().max()) < 4.0
    assert float(nominal.abs().max()) > 20.0


def test_default_features_are_plain_ones_without_a_closest_fit(recording):
    options = DataOptions(initial_state="recorded")
    assert prepare(pendulum, recording, options).summary.to_dict()["embedding"] == "bayessim"
    chosen = replace(options, embedding="all/10")
    assert prepare(pendulum, recording, chosen).summary.to_dict()["embedding"] == "all/10"
