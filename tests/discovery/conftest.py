"""Fitted models of hidden pendulums, for tests of single parts of discovery."""

import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import QuadraticDrag


@pytest.fixture(scope="session")
def quiet():
    """A pendulum without anything hidden, fitted."""
    case = make_case("pendulum", "null", (), seed=2001)
    data_options = segment_options(case.fit)
    return fit_hypothesis(case.model, case.fit, data_options)


@pytest.fixture(scope="session")
def dragged():
    """A pendulum in a hidden drag, fitted without it."""
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=0.3, seed=2001)
    data_options = segment_options(case.fit)
    return case, fit_hypothesis(case.model, case.fit, data_options)


@pytest.fixture(scope="session")
def proven():
    """A search that finds a hidden drag, with held-out rollouts: the case, options, result."""
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=1.0, seed=2001)
    options = npdr.DiscoveryOptions(effects=(QuadraticDrag("hinge"),), max_effects=1)
    found = npdr.discover(case.model, case.fit, holdout=case.holdout, search=options)
    return case, options, found
