"""An ambiguous discovery of a hidden pendulum."""

import pytest
from hidden_rigs import RIGS, make_case

import npdr_ppl as npdr
from npdr_ppl.planning.causes import causes_of_prior, causes_of_run
from npdr_ppl.planning.limits import default_limits, read_limits


@pytest.fixture(scope="session")
def ambiguous(tmp_path_factory):
    """A case with weak dry friction, and the folder of its discovery from one rollout."""
    case = make_case("pendulum", "one", (("hinge", "coulomb_friction"),), strength=0.1, seed=3)
    search = npdr.DiscoveryOptions(confidence=0.99)
    found = npdr.discover(case.model, case.fit[[0]], search=search)
    assert found.verdict == "ambiguous"
    folder = tmp_path_factory.mktemp("discovery")
    found.save(folder)
    return case, folder


@pytest.fixture(scope="session")
def surviving(ambiguous):
    """Its causes, and the limits of its recording."""
    case, folder = ambiguous
    known = causes_of_run(folder, case.model)
    limits = read_limits(None, default_limits(known.causes[0].simulator, known.recorded))
    return known, limits


@pytest.fixture(scope="session")
def unrecorded():
    """Draws of the pendulum's prior, and the limits that the model declares."""
    known = causes_of_prior(RIGS["pendulum"].model, seed=0)
    return known, read_limits(None, default_limits(known.causes[0].simulator, None))
