"""Cases of the blind benchmark: deterministic, complete, and spoilt as they say."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
from discovery_rows import SEVERAL
from hidden_rigs import CONDITIONS, RIGS, cases, make_case, places
from hidden_rigs.measurement import Measurement, noisy

from npdr_ppl.errors import ModelError

ONE = (("hinge", "coulomb_friction"),)


@pytest.mark.parametrize("name", RIGS)
def test_a_case_is_whole_and_quick(name):
    rig = RIGS[name]
    rig.simulator()
    start = time.process_time()
    case = make_case(name, "null", seed=0)
    assert time.process_time() - start < 4.0  # takes under one on a free core
    assert case.truth == case.alternatives == ()
    assert len(case.fit) == 4
    assert len(case.holdout) == 2
    for rollouts in (case.fit, case.holdout):
        rollouts.check(rig.simulator().sensors, rig.simulator().actions)
        for commands, limit in zip(np.concatenate(rollouts.actions).T, rig.limits, strict=True):
            assert 0.5 * limit < np.abs(commands).max() <= limit
    inside = [p for p in rig.unknown if not rig.unknown[p][0] <= case.parameters[p]]
    assert not inside


@pytest.mark.slow
def test_the_seed_decides_everything_but_the_strength():
    first, again = (make_case("pendulum", "one", ONE, seed=4) for _ in range(2))
    assert first.fit == again.fit
    assert first.truth == again.truth
    other = make_case("pendulum", "one", ONE, seed=5)
    assert other.parameters != first.parameters
    stronger = make_case("pendulum", "one", ONE, strength=2.5, seed=4)
    assert stronger.parameters == first.parameters
    ratio = stronger.truth[0].parameters["magnitude"] / first.truth[0].parameters["magnitude"]
    assert ratio == pytest.approx(2.5)
    weak = make_case("pendulum", "one", ONE, strength=1e-9, seed=4)
    null = make_case("pendulum", "null", seed=4)
    difference = np.abs(np.stack(weak.fit.readings) - np.stack(null.fit.readings))
    # The noise is the same too.
    assert np.quantile(difference, 0.9) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS)
def test_conditions(condition, monkeypatch):
    # Nothing below looks at the motion, so a short one will do.
    monkeypatch.setitem(RIGS, "emps", replace(RIGS["emps"], duration=0.5))
    number = len(places("emps", condition))
    # Of conditions with many places one strength will do: the loop over strengths is shared.
    strengths = [2.0] if number > 6 else [0.5, 2.0]
    found = list(cases(condition, seeds=[0], rigs=["emps"], strengths=strengths))
    scaled = condition in ("one", *SEVERAL, "inseparable", "outside", "absorbed")
    assert len(found) == number * (len(strengths) if scaled else 1)
    sizes = (
        dict.fromkeys(SEVERAL, 2)
        | {"three": 3}
        | {c: 0 for c in CONDITIONS if c.startswith("null")}
    )
    for case in found:
        assert case.condition == condition
        assert len(case.truth) == sizes.get(condition, 1)
        if condition == "inseparable":
            assert case.alternatives
            assert all(set(a).isdisjoint(case.names) for a in case.alternatives)


def test_pairs_are_not_alternatives_of_each_other():
    for name in RIGS:
        for seed in range(20):
            ((first, second),) = places(name, "two", seed)
            assert first[0] != second[0]
            assert (second,) not in RIGS[name].inseparable.get(first, ())


def test_pairs_at_one_place_are_effects_of_the_rig():
    for rig in (RIGS[name] for name in ("pendulum", "cart_pole", "emps")):
        pairs = places(rig.name, "two_at_one_place")
        assert len(pairs) == 10
        for pair in pairs:
            assert len({port for port, _ in pair}) == 1
            assert len(set(pair)) == 2
            assert set(pair) <= set(rig.effects)


def test_three_effects_are_apart_from_each_other():
    for seed in range(5):
        ((*chosen,),) = places("pendulum", "three", seed)
        assert len({port for port, _ in chosen}) == len({effect for _, effect in chosen}) == 3
        rig = RIGS["pendulum"]
        for first, second in itertools.permutations(chosen, 2):
            assert (second,) not in (*rig.inseparable.get(first, ()), *rig.same.get(first, ()))


def test_what_comes_to_the_same_is_said():
    case = make_case("pendulum", "one", (("gravity", "tilt"),), seed=0)
    assert ("angle.encoder_bias",) in case.alternatives
    case = make_case("emps", "one", (("carriage", "asymmetric_coulomb_friction"),), seed=0)
    assert case.alternatives == (("carriage.coulomb_friction", "carriage.bias"),)


@pytest.mark.slow
def test_faults_spoil_the_data_as_they_say():
    sound = make_case("pendulum", "null", seed=0).fit
    by_kind = {
        kind: make_case("pendulum", "bad_data", (("data", kind),), seed=0)
        for ((_, kind),) in places("pendulum", "bad_data")
    }
    for name, factor in (("degrees", 180.0 / np.pi), ("flipped", -1.0)):
        np.testing.assert_allclose(
            np.stack(by_kind[name].fit.readings), factor * np.stack(sound.readings)
        )
    flipped = by_kind["flipped_action"].fit
    np.testing.assert_array_equal(np.stack(flipped.actions), -np.stack(sound.actions))
    late = by_kind["misaligned"]
    steps = int(late.truth[0].parameters["steps"])
    assert 8 <= abs(steps) < 20
    assert late.fit.lengths[0] == sound.lengths[0] - abs(steps)
    assert max(by_kind["dropped"].fit.lengths) < sound.lengths[0]


def test_noise_is_as_declared():
    generator = np.random.default_rng(0)
    measurement = Measurement((0.01,), (0.5,))
    clean = np.zeros((4, 5000, 2))
    white = noisy(clean + 0.003, measurement, generator)
    assert (white[..., 0] == 0.0).all()
    # Standard errors are 0.5 % of the deviation; bounds at four of them.
    assert white[..., 1].std() == pytest.approx(0.5, rel=0.02)
    coloured = noisy(clean, Measurement((0.01,), (0.5,), is_coloured=True), generator)[..., 1]
    assert coloured.std() == pytest.approx(0.5, rel=0.06)
    correlation = (coloured[:, 1:] * coloured[:, :-1]).mean() / coloured.var()
    assert correlation == pytest.approx(0.8, abs=0.03)
    outliers = noisy(clean, Measurement((0.01,), (0.5,), has_outliers=True), generator)[..., 1]
    share = (np.abs(outliers) > 2.5).mean()
    # One in a hundred, of which three quarters are further off than five deviations.
    assert share == pytest.approx(0.0075, abs=0.0025)
    assert measurement.scaled(3.0).counts == (0.03,)


def test_errors_name_what_there_is():
    with pytest.raises(ModelError, match="emps"):
        make_case("robot", "null", seed=0)
    with pytest.raises(ModelError, match="above 0"):
        make_case("pendulum", "one", ONE, strength=0.0, seed=0)
    with pytest.raises(ModelError, match="inseparable"):
        places("emps", "four")
