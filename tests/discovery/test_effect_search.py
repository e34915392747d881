"""Candidates that are tried in a round, and the alternatives to each effect."""

from dataclasses import replace

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search.effect_search import Searcher
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
    tried = searcher.trials.extended(base, ranking)
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
    _, added, trials = searcher.with_rivals(all_three, rounds)
    assert [each.place for each in added] == [effect.name for effect in three]
    for effect in three:
        others = {other.name for other in three} - {effect.name}
        assert set(trials[effect.name, "hinge.cogging"].names) == others | {"hinge.cogging"}
    # The drag is there and the others are not, so that all is lost without it.
    assert added[0].share > 0.5 > added[2].share
