"""Predicted separations and information, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from npdr_ppl.planning.causes import Known
from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.judging import Judge
from npdr_ppl.planning.limits import ChannelLimits
from npdr_ppl.planning.separations import information_gain
from npdr_ppl.planning.settings import PLANNING


def candidates(limits, number=4):
    excitations = Excitations(limits, np.random.default_rng(0))
    made = excitations.random(number)
    return (
        np.stack([excitations.commands(c) for c in made]),
        np.stack([excitations.start(c) for c in made]),
    )


def separations(judge, played):
    """Squared separations along each candidate alone, ``(E, n, n)``."""
    shown, num = judge.shown(played), len(judge.known.causes)
    result = np.zeros((len(played.commands), num, num))
    for k in range(len(result)):
        for (a, b), blocks in shown.squares([k]).items():
            result[k, a, b] = blocks.sum()
    return result


def shifted(known, by):
    """The first cause, and the same with other parameters, both known as well as before."""
    first = known.causes[0]
    causes = (first, replace(first, z=first.z + by))
    return Known(causes, torch.zeros(2, 2), known.time_step, share=0.5)


@pytest.mark.slow
def test_a_cause_with_other_parameters_imitates_what_the_precision_permits(surviving):
    known, limits = surviving
    width = known.causes[0].precision.inverse().diagonal().sqrt()
    by = 0.3 * width
    judge = Judge(shifted(known, by), limits, seed=0)
    played = judge.played(*candidates(limits))
    found = separations(judge, played)[:, 0, 1]
    before = known.causes[0].precision
    # In a linear model the difference is J times the shift. Both recordings together determine
    # the parameters as a mean of two estimates with these precisions, a shift apart.
    for index, after in enumerate(judge.precisions(played, 1)):
        covariance = before.inverse() + (after - before).inverse()
        expected = float(by @ covariance.inverse() @ by)
        assert found[index] == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_a_cause_is_not_separated_from_itself(surviving):
    known, limits = surviving
    judge = Judge(shifted(known, 0.0), limits, seed=0)
    assert separations(judge, judge.played(*candidates(limits))) == pytest.approx(0.0, abs=1e-6)


def test_fewer_candidates_are_judged_if_each_takes_long(unrecorded):
    known, limits = unrecorded
    short, long = (
        Judge(known, replace(limits, duration=seconds), seed=0) for seconds in (5.0, 2000.0)
    )
    assert short.most_shown > long.most_shown == 1


@pytest.mark.slow
def test_less_noise_separates_more(surviving):
    known, limits = surviving
    channels = {n: replace(c, noise=0.5 * c.noise) for n, c in limits.channels.items()}
    squares = []
    for allowed in (limits, replace(limits, channels=channels)):
        judge = Judge(known, allowed, seed=0)
        squares.append(separations(judge, judge.played(*candidates(limits))))
    # Two that are closer than one standard deviation stay so, up to errors of the derivatives by
    # the initial state: friction holds the joint there, or does not.
    apart = squares[0] > 1.0
    assert apart.sum() > len(known.causes)
    assert (squares[1] > squares[0])[apart].all()


@pytest.mark.slow
def test_a_repeated_rollout_separates_at_most_twice_as_much(surviving):
    known, limits = surviving
    judge = Judge(known, limits, seed=0)
    shown = judge.shown(judge.played(*candidates(limits)))
    for pair, once in shown.squares([0]).items():
        twice = shown.squares([0, 0])[pair]
        # What is known of the parameters counts once, so it is at most twice as much.
        assert len(twice) == 2 * len(once)
        assert 1.0 - 1e-9 <= twice.sum() / once.sum() <= 2.0 + 1e-9
        # Parameters that fit two rollouts fit neither of them better than its own.
        other = shown.squares([1])[pair].sum()
        assert shown.squares([0, 1])[pair].sum() >= max(once.sum(), other) * (1.0 - 1e-9)


@pytest.mark.slow
def test_certainty_is_that_of_the_pairs(surviving):
    known, limits = surviving
    pair = replace(known, causes=known.causes[:2], separations=known.separations[:2, :2])
    judge = Judge(pair, limits, seed=0)
    played = judge.played(*candidates(limits))
    before = -0.5 * np.log(pair.probabilities).sum()
    gained = judge.certainty(played) - before
    # Π_k (1 + d_k²/8) of parts d_k² is at least 1 + d²/8 and at most exp(d²/8).
    square = separations(judge, played)[:, 0, 1]
    assert (gained >= np.log1p(square / 8.0) * (1.0 - 1e-6)).all()
    assert (gained <= square / 8.0 * (1.0 + 1e-6)).all()
    assert (gained > 1.01 * np.log1p(square / 8.0)).any()


@pytest.mark.slow
def test_certainty_grows_with_the_motion(surviving):
    known, limits = surviving
    judge = Judge(known, limits, seed=0)
    played = judge.played(*candidates(limits))
    certain = judge.certainty(played)
    assert certain.shape == (4,)
    # Nothing is learned from standing still.
    still = judge.played(np.zeros_like(played.commands), played.start)
    assert (certain > judge.certainty(still)).all()


def test_information_of_a_gaussian():
    before, after = torch.eye(2).double(), torch.diag(torch.tensor([4.0, 9.0])).double()
    assert float(information_gain(before, after[None])[0]) == pytest.approx(np.log(6.0))


def test_information_grows_with_the_motion(unrecorded):
    known, limits = unrecorded
    judge = Judge(known, limits, seed=0)
    commands, start = candidates(limits)
    weak, strong = (judge.gains(judge.played(f * commands, start)) for f in (0.1, 1.0))
    assert (strong > weak).all() and (weak > 0.0).all()


@pytest.mark.parametrize("name", ["min", "max", "max_rate", "max_acceleration"])
def test_a_limit_that_the_motion_exceeds_is_a_violation(name, unrecorded):
    known, limits = unrecorded
    free = {name: ChannelLimits(noise=c.noise) for name, c in limits.channels.items()}
    limits = replace(limits, channels=free)
    judge = Judge(known, limits, seed=0)
    played = judge.played(*candidates(limits))
    path = np.concatenate((np.zeros_like(played.readings[:, :, :1]), played.readings), axis=2)
    angle = path[..., 0]
    rate = np.diff(angle) / limits.time_step
    acceleration = np.diff(rate) / limits.time_step
    greatest = {
        "min": angle.min((0, 2)),
        "max": angle.max((0, 2)),
        "max_rate": np.abs(rate).max((0, 2)),
        "max_acceleration": np.abs(acceleration).max((0, 2)),
    }[name]
    assert (judge.violation(played) <= 0.0).all()
    for factor, is_kept in ((1.1, True), (1.01, False)):  # a margin of a twentieth is kept
        channel = ChannelLimits(noise=1e-3)
        channel = replace(channel, **{name: factor * float(greatest[0])})
        narrow = replace(limits, channels=limits.channels | {"angle": channel})
        violation = Judge(known, narrow, seed=0).violation(played)
        assert (violation[0] <= 0.0) == is_kept


@pytest.mark.slow
def test_what_a_tiny_motion_shows_counts_less(surviving):
    known, limits = surviving
    judge = Judge(known, limits, seed=0)
    commands, _ = candidates(limits, 1)
    rest = np.zeros((2, len(limits.channels)))
    played = judge.played(np.concatenate((commands, 1e-3 * commands)), rest)
    channels = known.recorded["channels"]
    reach = np.ptp(played.readings[0], axis=1)
    recorded = [channels[name]["max"] - channels[name]["min"] for name in limits.channels]
    large, tiny = (reach / recorded).max(axis=1)
    assert large > PLANNING.least_motion > tiny
    trusted = judge.information(played, 0)
    everything = Judge(replace(known, recorded=None), limits, seed=0).information(played, 0)
    torch.testing.assert_close(trusted[0], everything[0])
    share = (tiny / PLANNING.least_motion) ** 2
    torch.testing.assert_close(trusted[1], share * everything[1], rtol=0.01, atol=1e-6)


@pytest.mark.slow
def test_the_motion_of_a_joint_that_rested_is_compared_with_its_limits(surviving):
    known, limits = surviving
    channels = {name: {"min": 0.0, "max": 0.0} for name in limits.channels}
    rested = replace(known, recorded={**known.recorded, "channels": channels})
    played = Judge(known, limits, seed=0).played(*candidates(limits, 1))
    reach = np.ptp(played.readings[0], axis=1)[0]
    wide = {
        name: replace(c, min=-4.0 * r / PLANNING.least_motion, max=4.0 * r / PLANNING.least_motion)
        for (name, c), r in zip(limits.channels.items(), reach, strict=True)
    }
    wide = replace(limits, channels=wide)
    seen, every = (Judge(k, wide, seed=0) for k in (rested, replace(known, recorded=None)))
    one, other = (judge.information(played, 0) for judge in (seen, every))
    torch.testing.assert_close(one, other / 8.0**2, rtol=0.05, atol=1e-6)
