"""Narrow priors and missing effects of default fits: what is special about them is so."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from clean_fits_conditions import SEPARATION, _cut, made, own_model
from clean_fits_rigs import RIG_SUBJECTS, drawn_parameters, prior_ranges, record_rig
from clean_fits_separation import replayed, separation
from clean_fits_subjects import recorded
from hidden_rigs import Hidden
from scipy.optimize import least_squares

from npdr_ppl.cli.resolve import resolve_model
from npdr_ppl.language.prior import Prior

SEED = 5


def short(name, duration=1.0):
    subject = RIG_SUBJECTS[name]
    return replace(subject, rig=replace(subject.rig, duration=duration))


@pytest.mark.slow
@pytest.mark.parametrize("name", RIG_SUBJECTS)
def test_a_replay_of_the_true_parameters_is_the_recording(name):
    """The recorder's own integrator has other code, and drives the rig in a closed loop."""
    subject = short(name, 0.5)
    parameters = drawn_parameters(subject, SEED)
    recording = record_rig(subject, parameters, seed=SEED, is_noisy=False)
    starts = recording.true_states[:, 0].T
    commands = np.stack(recording.rollouts.actions, axis=-1)
    known = {**subject.rig.known, **parameters}
    found = replayed(subject.rig, known, starts, commands, subject.rig.substeps)
    expected = recording.true_states[:, 1:].transpose(1, 2, 0)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_the_separation_is_the_least_distance():
    """SciPy minimises the same sum of squares by another route."""
    subject = short("pendulum")
    rig, prior = subject.rig, prior_ranges("pendulum")
    truth = drawn_parameters(subject, SEED)
    friction = Hidden("hinge", "coulomb_friction", {"magnitude": 0.05})
    recording = record_rig(subject, truth, seed=SEED, is_noisy=False, hidden=(friction,))
    found = separation(rig, recording, truth, prior, (0,))
    length = 25  # of half a second
    actions, readings = recording.rollouts.actions[0], recording.rollouts.readings[0]
    firsts = (0, length)
    commands = np.stack([actions[k : k + length] for k in firsts], axis=-1)
    measured = np.stack([readings[k + 1 : k + length + 1] for k in firsts], axis=-1)
    noise = np.array([2.0 * np.pi / 4096 / np.sqrt(12.0), 0.02])[:, None]

    def residual(x):
        parameters = {**rig.known, "mass": x[0], "length": x[1]}
        states = replayed(rig, parameters, x[2:].reshape(2, 2), commands, rig.substeps)
        return ((measured - states) / noise).ravel()

    starts = np.stack([readings[k] for k in firsts], axis=-1).ravel()
    start = np.concatenate(([truth["mass"], truth["length"]], starts))
    best = least_squares(residual, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert found == pytest.approx(np.sqrt(2.0 * best.cost), rel=1e-3)
    assert found > 1.0


@pytest.mark.slow
def test_nothing_separates_a_clean_recording():
    subject = short("cart_pole", 0.5)
    prior = prior_ranges("cart_pole")
    truth = drawn_parameters(subject, SEED)
    recording = record_rig(subject, truth, seed=SEED, is_noisy=False)
    begin = {name: 0.95 * truth[name] + 0.05 * np.mean(prior[name]) for name in truth}
    # Even where the fit begins elsewhere.
    assert separation(subject.rig, recording, begin, prior, (0, 1)) < 1e-3


def test_a_prior_is_cut_on_its_wider_side():
    assert _cut((0.0, 1.0), 0.7, 0.1) == pytest.approx((0.0, 0.6))
    assert _cut((0.0, 1.0), 0.3, 0.1) == pytest.approx((0.4, 1.0))
    assert _cut((0.0, 1.0), 0.5, 0.4) is None


@pytest.mark.slow
def test_a_narrow_prior_excludes_the_truth_and_nothing_else():
    found, clean = made("pendulum", "narrow", SEED), recorded("pendulum", SEED)
    assert found.rollouts == clean.rollouts
    narrowed = found.notes["narrowed"]
    low, high = found.prior[narrowed]
    assert not low <= found.truth[narrowed] <= high
    assert {k: v for k, v in found.prior.items() if k != narrowed} == {
        k: v for k, v in clean.prior.items() if k != narrowed
    }
    assert found.notes["separation"] >= SEPARATION


@pytest.mark.parametrize("name", RIG_SUBJECTS)
def test_an_own_model_is_the_zoos_but_for_its_priors(name, tmp_path):
    prior = {k: (low, 0.5 * (low + high)) for k, (low, high) in prior_ranges(name).items()}
    (tmp_path / "model.py").write_text(own_model(name, prior))
    own = resolve_model(f"{tmp_path / 'model.py'}:model")
    subject = short(name, 0.1)
    recording = record_rig(subject, drawn_parameters(subject, SEED), seed=SEED)
    args = (recording.rollouts.inputs(),)
    of_own, of_zoo = Prior(own, args), Prior(resolve_model(name), args)
    assert [site.name for site in of_own.sites] == [site.name for site in of_zoo.sites]
    draws = of_own.to_parameters(of_own.sample(200))
    for parameter, (low, high) in prior.items():
        assert float(draws[parameter].min()) >= low - 1e-6 * abs(low)
        assert float(draws[parameter].max()) <= high + 1e-6 * abs(high)
    mean = {k: torch.tensor([0.5 * (low + high)]) for k, (low, high) in prior.items()}
    same = [p.execute_at(mean)["trajectory"] for p in (of_own, of_zoo)]
    torch.testing.assert_close(*same, rtol=0.0, atol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("condition", ["friction", "weak_friction"])
def test_an_effect_is_hidden_and_separates(condition):
    found, clean = made("emps", condition, SEED), recorded("emps", SEED)
    assert found.notes["hidden"] == "carriage.coulomb_friction"
    assert found.truth == clean.truth
    assert found.rollouts != clean.rollouts
    assert found.notes["separation"] >= SEPARATION
    if condition == "weak_friction":
        assert found.notes["separation"] <= 2.0 * SEPARATION
