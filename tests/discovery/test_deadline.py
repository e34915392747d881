"""A time limit ends a search with the best answer so far, and says so."""

import json

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.investigation import Investigation
from npdr_ppl.discovery.search.deadline import Deadline
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.shortlist import fit_shortlist
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag, ViscousFriction
from tests.helpers.command_line import run_for_module


def test_a_deadline_remembers_that_it_has_stopped_something():
    now = [0.0]
    deadline = Deadline(10.0, lambda: now[0])
    assert not deadline.stops() and not deadline.has_stopped
    now[0] = 10.0
    assert not deadline.has_stopped  # nothing was asked for since
    assert deadline.stops() and deadline.has_stopped
    assert not Deadline(None, lambda: 1e9).stops()


def test_a_time_limit_is_a_number_of_seconds():
    with pytest.raises(DataError, match="time_limit is a number of seconds"):
        npdr.DiscoveryOptions(time_limit=0.0)


class After(Deadline):
    """A deadline that is over after it was asked a number of times."""

    def __init__(self, number):
        super().__init__()
        self.left = number

    def stops(self):
        self.left -= 1
        self.has_stopped = self.has_stopped or self.left < 0
        return self.has_stopped


EFFECTS = QuadraticDrag("hinge"), CoulombFriction("hinge"), ViscousFriction("hinge")


def test_candidates_that_are_not_fitted_in_time_are_left_out(dragged):
    case, base = dragged
    options = npdr.DiscoveryOptions(effects=EFFECTS)
    searcher = Searcher(case.model, case.fit, options)
    ranking = searcher.look(base).ranking
    tried = fit_shortlist(searcher.trials, base, ranking, stops=lambda: True)
    assert 1 <= len(tried) <= 2  # those of the first decision


@pytest.mark.slow
def test_a_search_keeps_what_it_found_in_time(dragged):
    case, base = dragged
    options = npdr.DiscoveryOptions(effects=EFFECTS)
    searcher = Searcher(case.model, case.fit, options, deadline=After(0))
    found = searcher.run(searcher.look(base), max_effects=5)
    # In time for the first effect, but not for its confirmation.
    assert found.has_stopped
    assert found.final.names == ("hinge.quadratic_drag",)
    assert len(found.added) == 1


@pytest.mark.slow
def test_draws_of_a_search_that_was_ended_early_are_not_simulated(dragged, monkeypatch):
    case, _ = dragged
    asked = []

    def drawn(hypothesis, *, seed):
        asked.append(hypothesis)

    monkeypatch.setattr("npdr_ppl.discovery.predictions.quick_draws", drawn)
    options = npdr.DiscoveryOptions(effects=EFFECTS, time_limit=1e-6)
    investigation = Investigation(case.model, case.fit, search=options)
    search = investigation.search
    assert search.has_stopped and not search.is_approximate
    investigation._predictions.draws(search.final)
    assert asked == [search.final]


def test_a_model_that_lacks_nothing_needs_no_further_time(quiet):
    case_options = npdr.DiscoveryOptions(effects=EFFECTS)
    segments = quiet.segments
    searcher = Searcher(segments.model, segments.rollouts, case_options, deadline=After(0))
    found = searcher.run(searcher.look(quiet), max_effects=5)
    assert not found.has_stopped and not found.added


@pytest.mark.slow
def test_the_same_command_continues_after_a_time_limit(dragged, tmp_path):
    case, _ = dragged
    case.fit.to_npz(tmp_path / "rec.npz")
    words = [
        "discover", "pendulum", "--data", tmp_path / "rec.npz", "--candidates",
        "hinge.quadratic_drag,hinge.coulomb_friction", "--out", tmp_path / "out",
    ]  # fmt: skip
    code, text, err = run_for_module(*words, "--time-limit", 0.001)
    assert code == 0, err
    found = json.loads((tmp_path / "out" / "discovery.json").read_text())
    assert found["has_stopped"] and found["verdict"] == "unknown"
    assert not any(effect["found_in"] for effect in found["effects"])
    assert "time limit of 0.001 s ended the search" in " ".join(text.split())
    assert "best explanation so far is hinge.quadratic_drag" in found["reason"]
    code, text, err = run_for_module(*words)
    assert code == 0, err
    found = json.loads((tmp_path / "out" / "discovery.json").read_text())
    assert not found["has_stopped"] and found["verdict"] == "named"
