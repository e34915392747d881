"""What discovery says is closed is measured on the held-out recording, and on nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.proof.estimated_anew import estimated_anew
from npdr_ppl.discovery.proof.held_out_gap import Gap, _Simulated, prove
from npdr_ppl.discovery.proof.overlays import overlay
from npdr_ppl.discovery.proof.parameter_intervals import posterior_draws
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.drawing.overlay_html import MODELS
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.models.effects import CoulombFriction, EncoderBias
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation import data_options
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging

DISTURBANCE = 0.5
"""Standard deviation of what is added to held-out velocities, rad/s: fifty times their noise."""


def disturbed(rollouts):
    """Returns rollouts whose velocities have white noise added."""
    rng = np.random.default_rng(0)
    readings = [
        r + DISTURBANCE * rng.standard_normal(r.shape) * [0.0, 1.0] for r in rollouts.readings
    ]
    return npdr.Rollouts.from_arrays(
        readings=readings, actions=rollouts.actions, channel_names=rollouts.channel_names,
        action_names=rollouts.action_names, time_step=rollouts.time_step,
    )  # fmt: skip


@pytest.fixture(scope="module")
def proofs(proven):
    """The same search with held-out rollouts as they were recorded, and with disturbed ones."""
    case, options, found = proven
    assert case.holdout.channel_names == ("angle", "velocity")
    holdout = disturbed(case.holdout)
    return found, npdr.discover(case.model, case.fit, holdout=holdout, search=options)


def test_the_closed_share_is_that_of_the_gap_above_the_noise_floor():
    assert Gap(3.0, 1.5, 1.0).closed == pytest.approx(0.75)
    assert Gap(3.0, 3.5, 1.0).closed == pytest.approx(-0.25)
    # Nothing is left to close, or there is no floor.
    assert Gap(1.1, 0.9, 1.0).closed is None and Gap(3.0, 1.0, None).closed is None


@pytest.mark.slow
def test_the_proof_is_of_the_held_out_rollouts(proofs):
    clean, noisy = (proof.gap for proof in proofs)
    assert clean["rmse"].closed > 0.5 and 0.8 < clean["coverage"].after <= 1.0
    for metric in ("rmse", "dtw", "crps"):
        # Noise that no model can follow is far more than the effect and the readings' own noise.
        assert noisy[metric].after > 3.0 * clean[metric].after
        assert noisy[metric].before > 3.0 * clean[metric].before
        # Without an error in the model it would be as large.
        assert noisy[metric].noise_floor > 3.0 * clean[metric].noise_floor
    # Half the readings are velocities, of which next to none is within the predicted interval.
    assert noisy["coverage"].after == pytest.approx(clean["coverage"].after / 2, abs=0.1)


@pytest.mark.slow
def test_held_out_rollouts_have_no_say_in_what_is_found(proofs):
    clean, noisy = proofs
    assert [f.to_dict() for f in clean.effects] == [f.to_dict() for f in noisy.effects]
    assert (clean.verdict, clean.reason) == (noisy.verdict, noisy.reason)
    assert clean.parameters == noisy.parameters


LENGTHS = 10, 20, 50
"""Steps of a segment; the shorter, the larger the part of the initial states' errors."""


@pytest.fixture
def proved():
    """Returns a proof of the true model on rollouts that it was not fitted to."""
    model = with_finer_steps(with_finer_steps(pendulum))

    def prove_at(length, seed=0):
        rollouts, held_out = (swinging(rollouts=2, steps=400, seed=k) for k in (seed, seed + 10))
        options = DataOptions(segment_length=length, initial_state="uncertain")
        hypothesis = fit_hypothesis(model, rollouts, options)
        draws = posterior_draws(hypothesis, seed=0)
        return prove(
            hypothesis, hypothesis, held_out, options,
            draws_before=draws, draws_after=draws, seed=0,
        )  # fmt: skip

    return prove_at


@pytest.mark.parametrize("length", LENGTHS)
def test_the_true_model_reaches_the_noise_floor(proved, length):
    found = proved(length)
    for metric in ("rmse", "dtw", "crps"):
        # A standard deviation over draws of the initial states is some 4 %.
        assert found[metric].after == pytest.approx(found[metric].noise_floor, rel=0.12), metric
    assert 0.85 < found["coverage"].after < 1.0


def test_a_long_recording_is_proved_on_all_of_it_with_draws_along_a_part(proved, monkeypatch):
    whole = proved(20)
    monkeypatch.setattr(data_options, "MOST_READINGS", 20 * 20 * 2)
    part = proved(20)
    for metric in ("rmse", "dtw"):
        # The fit used half the segments, and the proof simulates all of them.
        assert part[metric].after == pytest.approx(whole[metric].after, rel=0.05)
        assert part[metric].after == pytest.approx(part[metric].noise_floor, rel=0.12)
    assert part["crps"].after == pytest.approx(whole["crps"].after, rel=0.5)


def test_a_gap_is_open_if_most_of_it_is_left_above_the_noise_floor():
    assert Gap(3.0, 2.5, 1.0).is_open
    assert Gap(0.9, 1.5, 1.0).is_open
    assert not Gap(3.0, 1.5, 1.0).is_open
    assert not Gap(1.15, 1.14, 1.0).is_open
    assert Gap(1.0, 1.5, 2.0).is_open
    assert Gap(3.0, float("nan"), 1.0).is_open
    assert not Gap(3.0, 2.5, None).is_open


@pytest.mark.slow
def test_an_effect_that_held_out_rollouts_contradict_is_not_named():
    rubbed, free = swinging(friction=0.2), swinging(seed=1)
    search = npdr.DiscoveryOptions(effects=(CoulombFriction("hinge"),))
    alone = npdr.discover(pendulum, rubbed, search=search)
    assert alone.verdict == "named"
    found = npdr.discover(pendulum, rubbed, holdout=free, search=search)
    assert found.verdict == "unknown"
    assert "With hinge.coulomb_friction the error on the held-out rollouts grows" in found.reason


def test_no_segment_widens_its_own_band(proven):
    case, _, found = proven
    hypothesis = found.search.final
    drawn = posterior_draws(hypothesis, seed=0).resampled(3)
    simulated = _Simulated(hypothesis, drawn, case.holdout, segment_options(case.holdout))
    before = simulated._start_factors()
    now = simulated._along_part
    residual = now.residual.clone()
    residual[::2] *= 5.0
    simulated.__dict__["_along_part"] = replace(now, residual=residual)
    after = simulated._start_factors()
    assert torch.equal(after[::2], before[::2])
    assert bool((after[1::2] > 2.0 * before[1::2]).any())


def shifted(rollouts, offset):
    """Returns rollouts whose angle has an offset."""
    return npdr.Rollouts.from_arrays(
        readings=[r + [offset, 0.0] for r in rollouts.readings], actions=rollouts.actions,
        channel_names=rollouts.channel_names, action_names=rollouts.action_names,
        time_step=rollouts.time_step,
    )  # fmt: skip


@pytest.fixture(scope="module")
def switched_on_twice():
    """A fit to a recording with one zero of the encoder, and rollouts with another one."""
    model = with_finer_steps(with_finer_steps(pendulum))
    rollouts, held_out = shifted(swinging(), 0.02), shifted(swinging(seed=1), -0.03)
    options = segment_options(rollouts)
    before = fit_hypothesis(model, rollouts, options)
    after = fit_hypothesis(model, rollouts, options, effects=(EncoderBias("angle"),))
    return before, after, held_out, options


def test_an_encoders_zero_is_estimated_anew_on_held_out_rollouts(switched_on_twice):
    before, after, held_out, options = switched_on_twice
    anew = estimated_anew(after, held_out, options)
    assert anew is not None
    (values,) = anew.to_dict().values()
    assert values["searched"] == pytest.approx(0.02, abs=0.003)
    assert values["first half"] == pytest.approx(-0.03, abs=0.003)
    assert values["second half"] == pytest.approx(-0.03, abs=0.003)
    draws = [posterior_draws(each, seed=0) for each in (before, after)]
    old, new = (
        prove(
            before, after, held_out, options,
            draws_before=draws[0], draws_after=draws[1], seed=0, anew=each,
        )["rmse"]
        for each in (None, anew)
    )  # fmt: skip
    assert old.before == new.before
    assert old.has_grown and old.is_open
    assert new.after == pytest.approx(new.noise_floor, rel=0.12)


def test_no_half_is_predicted_with_its_own_values(switched_on_twice):
    _, after, held_out, options = switched_on_twice
    anew = estimated_anew(after, held_out, options)
    assert anew is not None
    segments = SegmentModel(after.model, held_out, options)
    late = torch.arange(segments.inputs.num_segments) >= segments.inputs.num_segments // 2
    # What is added to the first half's own value appears in the second half only.
    moved = replace(anew, shifts=anew.shifts.clone())
    moved.shifts[0, -1] += 1.0
    z, offsets = after.fit.z[None], segments.no_offsets[None]
    plain, other = (each.simulate(segments, z, offsets, late)[0] for each in (anew, moved))
    assert torch.equal(plain[~late], other[~late])
    assert not torch.isclose(plain[late], other[late]).all()


def test_other_parameters_keep_their_values(switched_on_twice):
    before, after, held_out, options = switched_on_twice
    assert estimated_anew(before, held_out, options) is None
    anew = estimated_anew(after, held_out, options)
    assert anew is not None
    sites = {site.name: site.coordinates for site in after.segments.prior.sites}
    for name, coordinates in sites.items():
        assert bool((anew.shifts[:, coordinates] != 0.0).all()) == ("encoder_bias" in name)


def test_noise_is_that_of_the_other_half(switched_on_twice):
    _, after, held_out, options = switched_on_twice
    anew = estimated_anew(after, held_out, options)
    assert anew is not None
    anew = replace(anew, scales=torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    noise = anew.noise_of(torch.tensor([False, True]))
    assert noise.tolist() == [[[3.0, 4.0]], [[1.0, 2.0]]]


def test_curves_of_held_out_rollouts_have_the_encoders_new_zero(switched_on_twice):
    before, after, held_out, options = switched_on_twice
    anew = estimated_anew(after, held_out, options)
    old, new = (
        overlay(before, after, before, held_out, options, is_held_out=True, anew=each)
        for each in (None, anew)
    )
    for shown in new.rollouts:
        (same,) = (one for one in old.rollouts if one.rollout == shown.rollout)
        assert shown.misfit[MODELS[-1]]["angle"] < 0.5 * same.misfit[MODELS[-1]]["angle"]
