"""How often a program is run and a recording is smoothed: once for each distinct use."""

from collections import Counter

import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.search.convergence import converge_likeliest
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.shortlist import fit_shortlist
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.prior import Prior
from npdr_ppl.models.effects import Bias, CoulombFriction, QuadraticDrag
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior import prepare as prepare_module
from npdr_ppl.posterior.fit import fit
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import segments, states


@pytest.fixture(scope="module")
def case():
    place = ("hinge", "quadratic_drag")
    return make_case("pendulum", "one", (place,), strength=0.3, seed=2001)


@pytest.fixture
def calls(monkeypatch):
    """Counts traces, bindings and the places that are smoothed."""
    counts = Counter()

    def counted(owner, name, label=lambda *_: None):
        function = getattr(owner, name)

        def wrapper(*args, **kwargs):
            counts[name if owner is not Prior else "traces", label(*args)] += 1
            return function(*args, **kwargs)

        monkeypatch.setattr(owner, name, wrapper)

    counted(Prior, "__init__")
    counted(SegmentModel, "_trace")
    counted(prepare_module, "bind")

    def place(readings, steps, time_step, *_):
        return readings.tobytes(), steps.tobytes(), time_step

    for module in (segments, states):
        counted(module, "estimate_states", place)
    return counts


def _number(counts, name):
    return sum(count for (called, _), count in counts.items() if called == name)


@pytest.mark.slow
def test_a_fit_runs_the_program_once_for_each_use_and_smooths_no_place_twice(case, calls):
    quick = backend("snpe-c", transforms=1, hidden=(8,), epochs=1, members=1)
    fit(pendulum, case.fit[:2], backend=quick, num_simulations=20, progress=False)
    # The model without its noise, for the repair and for the fit; the same with finer steps of
    # three kinds, along a part and along the whole recording; with wider priors; and in midpoint
    # steps, for the screening, the draws and the scores.
    assert 3 <= _number(calls, "_trace") <= 12
    # These, the model whose simulator is looked at, the model that is tried out, the model with
    # its own noise, the model with estimated noise, and the scores.
    assert _number(calls, "traces") == _number(calls, "_trace") + 5
    assert _number(calls, "bind") == 1
    smoothed = {key: count for key, count in calls.items() if key[0] == "estimate_states"}
    assert smoothed
    assert set(smoothed.values()) == {1}


def test_a_preparation_is_bound_once_however_often_it_is_used(case, calls):
    quick = backend("snpe-c", transforms=1, hidden=(8,), epochs=1, members=1)
    recording = case.fit[:1]
    prepared = prepare_module.prepare(case.model, recording, DataOptions())
    before = _number(calls, "traces")
    posteriors = [
        npdr.infer(
            prepared.model,
            recording,
            backend=quick,
            num_simulations=20,
            seed=seed,
            preparation=prepared,
            progress=False,
        )
        for seed in (0, 1)
    ]
    assert posteriors[0].bound is posteriors[1].bound
    # The scores' model, and the same in midpoint steps.
    assert _number(calls, "traces") == before + 2


def test_a_fit_starts_no_processes_to_look_at_a_recording_once(case, monkeypatch):
    prepared = prepare_module.prepare(case.model, case.fit[:1], DataOptions())

    def refuse(*_):
        raise AssertionError("A process was started.")

    with npdr.workers("loky", 2):
        monkeypatch.setattr("npdr_ppl.discovery.screening.variants.side_by_side", refuse)
        alarm = prepared.alarm
    assert alarm.fired


@pytest.mark.slow
def test_refits_of_a_model_do_not_run_the_program_again(case, calls):
    effects = QuadraticDrag("hinge"), CoulombFriction("hinge"), Bias("hinge")
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=effects))
    base = searcher.fit_base()
    assert _number(calls, "traces") == 1
    ranking = searcher.look(base).ranking
    # Screening simulates the model in midpoint steps: one for the candidates, one for pulses.
    assert _number(calls, "traces") == 3
    trials = fit_shortlist(searcher.trials, base, ranking)
    number = 3 + len(trials)
    assert _number(calls, "traces") == number
    trials = converge_likeliest(searcher.trials, trials, base)
    number += len(trials)  # once more along all segments
    found = searcher.trials.with_own_starts(trials["hinge.quadratic_drag"])
    searcher.trials.holding(found, [{"hinge.quadratic_drag.coefficient": 1.0}])
    assert _number(calls, "traces") == number
    # All of them hold the recording once.
    for trial in (*trials.values(), found):
        assert trial.segments.observed is base.segments.observed
        assert trial.segments.inputs.actions is base.segments.inputs.actions
