"""The baseline of the blind benchmark: missing forces along a recording, and their regression."""

import math

import numpy as np
import pytest
import sparse_regression
from hidden_rigs import make_case
from residual_forces import residual_forces
from sparse_regression import least_squares, select, sparse_choice

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.segment_options import segment_options


def fitted(case):
    return fit_hypothesis(case.model, case.fit, segment_options(case.fit))


def hidden(place, strength):
    return make_case("pendulum", "one" if place else "null", place, strength=strength, seed=0)


@pytest.fixture(scope="module")
def biased():
    """A pendulum with a hidden constant torque, which no parameter imitates."""
    case = hidden((("hinge", "bias"),), 1.0)
    return case, fitted(case)


@pytest.mark.slow
def test_the_residual_force_is_the_hidden_one_in_newton_metres(biased):
    case, hypothesis = biased
    found = residual_forces(hypothesis, case.fit)
    assert [port.name for port in found.ports] == ["hinge"]
    lengths = [len(force) for force in found.forces]
    assert lengths == list(case.fit.lengths)
    force = found.filtered(found.forces)[:, 0]
    error = force.std() / math.sqrt(len(force))
    true = case.truth[0].parameters["offset"]
    # The refitted weight takes a part, less than a tenth of it.
    assert abs(force.mean() - true) < 4.0 * error + 0.1 * abs(true)


def test_thresholded_least_squares_keeps_the_true_columns():
    pytest.importorskip("pysindy")
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(300, 8)) * np.geomspace(1e-3, 1e3, 8)
    force = 20.0 * columns[:, 1] - 3e-3 * columns[:, 6] + 0.05 * rng.normal(size=300)
    assert select(columns, force) == [1, 6]
    fit = least_squares(columns[:, [1, 6]], force)
    assert fit.coefficients == pytest.approx([20.0, -3e-3], rel=0.1)
    assert fit.misfit / 300 == pytest.approx(0.05**2, rel=4.0 * math.sqrt(2.0 / 300))


def test_nothing_is_kept_of_noise():
    pytest.importorskip("pysindy")
    rng = np.random.default_rng(2)
    kept = [select(rng.normal(size=(400, 6)), rng.normal(size=400)) for _ in range(50)]
    # Each column passes BIC by chance when |t| > √log 400, 1.4 % of the time.
    assert sum(map(bool, kept)) <= 10
    assert select(np.zeros((50, 2)), rng.normal(size=50)) == []


def test_a_force_is_named_and_a_null_is_not(biased):
    pytest.importorskip("pysindy")
    case, hypothesis = biased
    found = sparse_choice(hypothesis, case.fit)
    assert found.first == "hinge.bias"
    assert found.left_out == ""
    assert found.terms["hinge: 1"] == pytest.approx(case.truth[0].parameters["offset"], rel=0.2)
    null = hidden((), 1.0)
    assert sparse_choice(fitted(null), null.fit).to_dict() == {
        "first": None,
        "terms": {},
        "left_out": "",
    }


def test_two_joints_are_told_apart():
    pytest.importorskip("pysindy")
    case = make_case("furuta", "one", (("pole", "coulomb_friction"),), strength=0.5, seed=0)
    assert sparse_choice(fitted(case), case.fit).first == "pole.coulomb_friction"


def test_positions_that_are_not_on_record_are_named(biased, monkeypatch):
    monkeypatch.setattr(sparse_regression, "find_spec", lambda name: name)  # it is not needed
    case, hypothesis = biased
    blind = npdr.Rollouts.from_arrays(
        [values[:, 1:] for values in case.fit.readings],
        case.fit.actions,
        channel_names=case.fit.channel_names[1:],
        action_names=case.fit.action_names,
        time_step=case.fit.time_step,
    )
    assert "position on record for each of hinge" in sparse_choice(hypothesis, blind).left_out


def test_without_the_extra_it_says_so(biased, monkeypatch):
    case, hypothesis = biased
    monkeypatch.setattr(sparse_regression, "find_spec", lambda name: None)
    assert sparse_choice(hypothesis, case.fit).left_out == "not installed"
