"""Candidates that are tried in a round, and the alternatives to each effect."""

import math
from dataclasses import replace

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search import comparison, convergence, shortlist
from npdr_ppl.discovery.search.alternatives import find_alternatives
from npdr_ppl.discovery.search.comparison import compare_effects
from npdr_ppl.discovery.search.convergence import converge_along_best, converge_likeliest
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.evidence import log_evidence
from npdr_ppl.discovery.search.shortlist import fit_shortlist
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.handlers import num_finer_steps, with_finer_steps
from npdr_ppl.models.effects import (
    Bias,
    Cogging,
    CoulombFriction,
    QuadraticDrag,
    SupplySag,
    ViscousFriction,
)


def test_candidates_far_behind_the_best_one_are_not_fitted(dragged):
    case, base = dragged
    effects = (
        *(
            law("hinge")
            for law in (QuadraticDrag, ViscousFriction, CoulombFriction, Bias, Cogging)
        ),
        SupplySag("torque"),
    )
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=effects))
    ranking = searcher.look(base).ranking
    gains = {candidate.name: candidate.gain for candidate in ranking}
    tried = fit_shortlist(searcher.trials, base, ranking)
    assert list(tried)[:2] == [candidate.name for candidate in ranking[:2]]
    assert next(iter(tried)) == "hinge.quadratic_drag"
    missed = gains.keys() - tried.keys()
    assert missed
    # Even four times their linear gain would leave them 30 units of evidence behind.
    assert all(4.0 * gains[name] < gains["hinge.quadratic_drag"] for name in missed)


@pytest.mark.slow
def test_every_effect_gets_its_own_alternatives(dragged):
    case, _ = dragged
    three = QuadraticDrag("hinge"), CoulombFriction("hinge"), Bias("hinge")
    options = npdr.DiscoveryOptions(effects=(*three, Cogging("hinge")))
    searcher = Searcher(case.model, case.fit, options)
    two, all_three, ripple = (
        fit_hypothesis(case.model, case.fit, searcher.data_options, effects=effects)
        for effects in (three[:2], three, (*three[:2], Cogging("hinge")))
    )
    # The last one's were tried when it was added.
    tried = {"hinge.bias": all_three, "hinge.cogging": ripple}
    rounds = [searcher.look(searcher.fit_base()), replace(searcher.look(two), trials=tried)]
    _, added, trials = compare_effects(all_three, rounds, searcher.trials, searcher.options)
    assert [each.place for each in added] == [effect.name for effect in three]
    for effect in three:
        others = {other.name for other in three} - {effect.name}
        assert set(trials[effect.name, "hinge.cogging"].names) == others | {"hinge.cogging"}
    # The drag is there and the others are not, so that all is lost without it.
    assert added[0].share > 0.5 > added[2].share


def test_after_a_time_limit_effects_are_compared_with_nothing_new(dragged, monkeypatch):
    case, base = dragged
    both = QuadraticDrag("hinge"), CoulombFriction("hinge")
    options = npdr.DiscoveryOptions(effects=(*both, Bias("hinge")))
    searcher = Searcher(case.model, case.fit, options)
    found = fit_hypothesis(case.model, case.fit, searcher.data_options, effects=both)
    monkeypatch.setattr(comparison, "find_alternatives", lambda *_, **__: 1 / 0)
    _, added, _ = compare_effects(
        found, [searcher.look(base)], searcher.trials, options, stops=lambda: True
    )
    assert [each.alternatives for each in added] == [{e.name: 1.0} for e in both]
    assert not any(each.is_compared for each in added)
    drag, friction = (each.share for each in added)
    # Only drag is there; without it, friction would explain a part.
    assert 0.0 <= friction < 0.05 < drag <= 1.0


def test_candidates_are_fitted_along_a_part_where_one_explains_very_much(dragged, monkeypatch):
    case, base = dragged
    effects = QuadraticDrag("hinge"), ViscousFriction("hinge")
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=effects))
    ranking = searcher.look(base).ranking
    whole = base.segments.inputs.num_segments
    # Each independent measurement gives half of the fall of the log variance.
    num = float(base.segments.num_measured.sum())
    evidence = 0.5 * base.share * num * math.log(num / (num - ranking[0].gain))

    def with_enough(evidence):
        settings = replace(shortlist.TRIALS, enough_evidence=evidence, fewest_segments=3)
        monkeypatch.setattr(shortlist, "TRIALS", settings)
        tried = fit_shortlist(searcher.trials, base, ranking)
        assert tried
        return tried, {trial.segments.inputs.num_segments for trial in tried.values()}

    tried, sizes = with_enough(2.0 * evidence)
    assert sizes == {whole}
    expected = converge_likeliest(searcher.trials, tried, base)["hinge.quadratic_drag"]
    tried, sizes = with_enough(0.5 * evidence)
    assert sizes == {-(-whole // 2)}
    done = {"hinge.viscous_friction": searcher.trials.refitted(base, effects[1:])}
    found = converge_likeliest(
        searcher.trials, {"hinge.quadratic_drag": tried["hinge.quadratic_drag"]}, base, done=done
    )
    assert set(found) == {"hinge.quadratic_drag", "hinge.viscous_friction"}
    assert all(trial.segments.inputs.num_segments == whole for trial in found.values())
    losses = [
        float(trial.losses(expected.fit.scale).sum())
        for trial in (found["hinge.quadratic_drag"], expected)
    ]
    assert abs(losses[0] - losses[1]) < 1.0


def test_alternatives_begin_from_the_initial_states_of_the_model_with_the_effect(
    dragged, monkeypatch
):
    case, base = dragged
    laws = QuadraticDrag("hinge"), ViscousFriction("hinge"), Bias("hinge")
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=laws))
    current = searcher.trials.refitted(base, laws[:1])
    begun, fits = [], Trials.fits

    def noted(self, asked, simulator):
        begun.extend(fit.offsets for fit in asked)
        return fits(self, asked, simulator)

    monkeypatch.setattr(Trials, "fits", noted)
    found = find_alternatives(current, laws[0], searcher.trials, searcher.options)
    assert set(found.others) == {"hinge.viscous_friction"}
    # Those of the model without the effect are far off, and lead to local minima.
    assert not torch.equal(found.without.fit.offsets, current.fit.offsets)
    assert len(begun) > 2  # without the effect, then short and long fits
    # Short fits are made along a part of the segments.
    assert all(bool(torch.isin(offsets, current.fit.offsets).all()) for offsets in begun)


def test_alternatives_to_a_candidate_that_explains_very_much_start_where_it_does(
    dragged, monkeypatch
):
    case, base = dragged
    laws = QuadraticDrag("hinge"), ViscousFriction("hinge"), Bias("hinge")
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=laws))
    tried = {law.name: searcher.trials.refitted(base, (law,)) for law in laws}
    evidence = log_evidence(base, tried["hinge.quadratic_drag"])

    def with_enough(evidence):
        settings = replace(
            convergence.TRIALS, enough_evidence=evidence, most_converged=2, converged_loss=1000.0
        )
        monkeypatch.setattr(convergence, "TRIALS", settings)
        return converge_along_best(searcher.trials, tried, base)

    late = converge_along_best(searcher.trials, tried, base, stops=lambda: True)
    assert all(late[name] is trial for name, trial in tried.items())
    before, after = with_enough(1.1 * evidence), with_enough(0.9 * evidence)
    assert set(before) == set(tried)
    assert list(after) == ["hinge.quadratic_drag", "hinge.viscous_friction"]
    assert {trial.segments.starts for trial in before.values()} == {base.segments.starts}
    (starts,) = {trial.segments.starts for trial in after.values()}
    assert starts is not base.segments.starts
    # The measured states are accurate here, so that little changes.
    gaps = [
        log_evidence(each["hinge.viscous_friction"], each["hinge.quadratic_drag"])
        for each in (before, after)
    ]
    assert gaps[1] == pytest.approx(gaps[0], rel=0.1)


@pytest.mark.parametrize("looks", [True, False])
def test_what_was_hopeless_in_coarse_steps_is_not_fitted_again(dragged, looks):
    case, _ = dragged
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=(Bias("hinge"),)))
    looked = searcher.look(searcher.fit_base())
    # Without another look, those that did not come to a full fit are hopeless, too.
    weights = {"": 0.0, "hinge.bias": 1e-200, "hinge.cogging": 0.3} if looks else {"": 0.0}
    coarse = replace(looked, weights=weights, hopeless=frozenset({"hinge.spring"}))
    (again,) = searcher._begun_again([coarse], looks=looks)
    # A new look begins anew; without one, what was not fitted before stays hopeless.
    assert again.hopeless == {"", "hinge.bias"} | (set() if looks else {"hinge.spring"})
    assert again.hypothesis is not looked.hypothesis
    assert not again.weights
    # With all candidates hopeless, there is nothing to fit.
    assert searcher._extended(again.hypothesis, again) == (None, {}, {})


def test_after_a_small_change_the_effects_that_were_added_are_kept(dragged):
    case, base = dragged
    laws = QuadraticDrag("hinge"), Bias("hinge")
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=laws))
    first = searcher.look(base)
    added = searcher.look(searcher.trials.refitted(base, laws[:1]))
    rounds = [first, replace(added, weights={"": 0.5, "hinge.bias": 0.5})]
    searcher.base = searcher.base.with_model(with_finer_steps(case.model))
    (begun,) = searcher._begun_again(rounds, looks=True)
    again = searcher._begun_again(rounds, looks=False)
    assert begun.hypothesis.names == ()
    assert [round.hypothesis.names for round in again] == [(), ("hinge.quadratic_drag",)]
    for round in (begun, *again):
        assert num_finer_steps(round.hypothesis.segments.model) == 1
        assert not round.weights
    assert [round.is_stale for round in (begun, *again)] == [False, True, True]
    assert again[1].ranking is added.ranking
    assert not again[1].hopeless & {"hinge.bias"}
    # The steps were fine enough, so that the same parameters fit best.
    was, now = (r.hypothesis.parameters for r in (added, again[1]))
    for name, value in was.items():
        assert float(now[name]) == pytest.approx(float(value), rel=0.02)
    # The last round is looked at again before it decides anything.
    looked = searcher._looked(again[1].hypothesis, again)
    assert looked is again[-1] and not looked.is_stale and len(again) == 2
    assert looked.alarm is not added.alarm
