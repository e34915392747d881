"""Long recordings: trajectories are simulated in parts, and as many kept as memory allows."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.arviz_module import group
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior import arviz_export
from npdr_ppl.posterior.comparison import predictive_scores
from npdr_ppl.preparation import draw_budget
from npdr_ppl.preparation.binding import bind
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.draw_budget import affordable_draws
from npdr_ppl.preparation.effective_share import effective_share
from npdr_ppl.preparation.sampling_settings import DRAW_BUDGET

DRAWS = 30
"""Of each of two members."""


@pytest.fixture(params=["declared noise", "no noise"])
def posterior(request, quick, recording, noisy_pendulum):
    model = noisy_pendulum if request.param == "declared noise" else pendulum
    return npdr.infer(
        model, recording, backend=quick, rounds=1, num_simulations=100,
        options=npdr.DataOptions(segment_length=25, initial_state="recorded"),
        seed=0, progress=False,
    )  # fmt: skip


def exported(posterior):
    return {
        name: group(posterior.to_arviz(DRAWS, seed=0), name)
        for name in ("posterior", "posterior_predictive", "prior_predictive", "log_likelihood")
    }


def test_short_recordings_keep_every_draw_that_is_wanted():
    assert affordable_draws(500, 1_000) == 500
    # 60 s at 1 kHz, 7 channels, in double precision.
    long = affordable_draws(500, 7 * 60_000)
    assert DRAW_BUDGET.least_draws < long < 500 and long * 7 * 60_000 * 8 <= DRAW_BUDGET.most_bytes
    assert affordable_draws(500, 10**9) == DRAW_BUDGET.least_draws
    assert affordable_draws(5, 10**9) == 5


@pytest.mark.slow
def test_parts_have_the_likelihood_of_the_whole(posterior, monkeypatch):
    """By the definition, from trajectories that are all in memory."""
    one_at_a_time = dataclasses.replace(DRAW_BUDGET, measurements_per_part=1)
    monkeypatch.setattr(draw_budget, "DRAW_BUDGET", one_at_a_time)
    found = exported(posterior)["log_likelihood"]["trajectory"]
    observation, prior = posterior.bound.observations["trajectory"], posterior.prior
    z = posterior.sample_reference(DRAWS, seed=0).flatten(0, 1)
    if prior.black_boxes["trajectory"].has_density:
        expected = prior.pointwise_log_prob("trajectory", observation.value, z)
        predicted = None
    else:
        predicted = prior.execute(z)["trajectory"].double()
        residual = predicted - observation.value
        variance = residual.square().mean((0, 1, 2))
        expected = -0.5 * (residual.square() / variance + torch.log(2 * math.pi * variance))
    by_channel = expected.sum(2).numpy()  # (n, segments, channels)
    found = found.values.reshape(len(z), -1)
    # Each channel counts by its share of independent readings, the same for all segments.
    share, *_ = np.linalg.lstsq(by_channel.reshape(-1, 2), found.reshape(-1), rcond=None)
    np.testing.assert_allclose(by_channel @ share, found, rtol=1e-6)
    assert (share > 0).all() and (share <= 1 + 1e-9).all()
    if predicted is not None:
        left = (predicted - observation.value).mean(0)
        expected_share = effective_share(left, observation.inputs.mask[..., None])
        np.testing.assert_allclose(share, expected_share, rtol=1e-6)


def test_of_long_recordings_the_first_draws_are_kept(posterior, monkeypatch):
    whole = exported(posterior)
    monkeypatch.setattr(arviz_export, "affordable_draws", lambda wanted, n, **_: min(wanted, 4))
    few = exported(posterior)
    for name in ("posterior_predictive", "prior_predictive"):
        values, every = few[name]["trajectory"].values, whole[name]["trajectory"].values
        assert values.shape[1] == 4 and values.shape[0] == every.shape[0]
        np.testing.assert_array_equal(values, every[:, :4])
    # Likelihoods and parameters are small: all of them stay.
    for name, variable in (("log_likelihood", "trajectory"), ("posterior", "mass")):
        np.testing.assert_array_equal(few[name][variable].values, whole[name][variable].values)


def test_fewer_predictive_draws_score_alike(posterior, recording, noisy_pendulum, monkeypatch):
    bound = bind(noisy_pendulum, recording, DataOptions("bayessim", 25, "recorded"))

    def scores():
        return predictive_scores.predictive_scores(posterior, bound, {}, is_held_out=True)

    whole = scores()
    one_at_a_time = dataclasses.replace(DRAW_BUDGET, measurements_per_part=1)
    monkeypatch.setattr(draw_budget, "DRAW_BUDGET", one_at_a_time)
    parts = scores()
    np.testing.assert_array_equal(parts.elpd, whole.elpd)
    # Noise is drawn in another order; 200 draws of 400 readings leave a few per cent to chance.
    assert parts.crps == pytest.approx(whole.crps, rel=0.05)
    assert parts.coverage[0.8] == pytest.approx(whole.coverage[0.8], abs=0.06)
    monkeypatch.setattr(predictive_scores, "affordable_draws", lambda wanted, n: 50)
    assert scores().crps == pytest.approx(whole.crps, rel=0.1)


def test_channels_are_scored_as_they_are_together(posterior):
    """Mean over readings of |x − y| less half the mean distance of two draws, by definition."""
    bound = posterior.bound
    observation = bound.observations["trajectory"]
    z = posterior.sample_mixture(20, seed=3)
    torch.manual_seed(0)
    output = bound.prior.execute(z)["trajectory"].double()
    output[4] = torch.nan  # a draw that could not be simulated
    crps, coverage, failed = predictive_scores._of_readings(
        bound, {"trajectory": [output[:7], output[7:]]}
    )
    assert failed == 1
    kept = torch.cat([output[:4], output[5:]])
    observed = observation.value.double()
    error = (kept - observed).abs().mean(0)
    apart = (kept[:, None] - kept[None]).abs().mean((0, 1))
    expected = ((error - 0.5 * apart) / observed.abs().amax((0, 1))).mean()
    assert crps == pytest.approx(float(expected), rel=1e-6)
    ranks = ((kept < observed).sum(0) + 0.5) / 20
    assert coverage[0.5] == pytest.approx(float(((ranks - 0.5).abs() <= 0.25).double().mean()))


def test_only_steps_that_exist_and_channels_that_were_measured_are_scored(quick, recording):
    angles = dataclasses.replace(
        recording,
        readings=[r[:, :1] for r in recording.readings],
        channel_names=("angle",), channel_units=("",),
    )  # fmt: skip
    posterior = npdr.infer(
        pendulum, angles, backend=quick, rounds=1, num_simulations=50,
        options=npdr.DataOptions(segment_length=30, initial_state="estimated"),
        seed=0, progress=False,
    )  # fmt: skip
    (observation,) = posterior.bound.observations.values()
    ((column, observed, counted),) = predictive_scores._columns(observation)
    assert column == 0
    # 100 steps in segments of 30: the last has 10, and 20 that do not exist.
    assert counted.sum(-1).tolist() == [30, 30, 30, 10] * 2
    assert exported(posterior)["log_likelihood"]["trajectory"].shape == (2, DRAWS, 8)
