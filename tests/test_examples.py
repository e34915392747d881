"""The examples run, at a size that a test can afford."""

import importlib.util
from pathlib import Path

import pyro
import pytest

import npdr_ppl as npdr

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def fleet():
    spec = importlib.util.spec_from_file_location("fleet_example", EXAMPLES / "fleet.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_fleet_learns_a_likelihood_and_samples_hyper_parameters(fleet):
    inputs = fleet.chirp()
    learnt = fleet.learn(inputs, num_simulations=1000, seed=0)
    truth = fleet.draw_fleet(inputs, seed=1)
    assert truth.readings.shape == (fleet.NUM_ROLLOUTS, fleet.NUM_RIGS, 1, fleet.NUM_STEPS, 4)
    model = npdr.with_likelihood(fleet.fleet, learnt)
    draws = fleet.run_nuts(pyro.condition(model, {"readings": truth.readings}), inputs, 6, seed=2)
    assert draws["coordinates"].shape == (6, fleet.NUM_RIGS, len(fleet.RANGES))
    assert draws["mean"].isfinite().all()
    assert len(fleet.coverage(draws, truth)) == 2 * len(fleet.RANGES)
