"""Each decision of `compare` is reached by a posterior that a backend learnt from data."""

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.diagnostics import Decision
from tests.helpers.pendulum_recordings import swinging, too_short

QUICK = backend("snpe-a", epochs=10, members=2, components=1)


def diagnosis(model, data, method=QUICK, num_simulations=200):
    """Returns the diagnosis of the only row of a comparison."""
    found = npdr.compare(
        model, data, backends={"only": method}, rounds=1, num_simulations=num_simulations,
        progress=False,
    )  # fmt: skip
    return found.rows["only"].diagnosis


def six_times(*names):
    """Returns a model that measures the sum of some parameters six times.

    Args:
        names: Their names; every one is standard normal.
    """

    def model():
        values = {name: pyro.sample(name, dist.Normal(0.0, 1.0)) for name in names}

        def measured(**parameters):
            total = sum(value for name, value in parameters.items() if name != "idle")
            return total[..., None].expand(*total.shape, 6)

        npdr.simulate("x", measured, values, noise=0.3)

    return model


MEASURED = 0.5 + 0.3 * torch.tensor([-1.3, -0.7, -0.2, 0.2, 0.7, 1.3])


@pytest.mark.parametrize(
    ("names", "decision"),
    [
        (("level",), Decision.ACCEPT),
        (("level", "idle"), Decision.NEW_ROLLOUT),
        (tuple("abcdefgh"), Decision.OTHER_EXCITATION),
    ],
)
def test_measurements_of_a_sum_determine_it_but_not_its_terms(names, decision):
    method = backend("snpe-a", epochs=60, members=2, components=1)
    found = diagnosis(six_times(*names), MEASURED, method, 1_000)
    assert found.decision is decision, found
    if decision is Decision.NEW_ROLLOUT:
        assert "nothing of idle" in found.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "friction", "decision", "reason"),
    [
        (pendulum, 0.15, Decision.REVISE_MODEL, "an effect is missing in the model"),
        (too_short, 0.0, Decision.WIDEN, "length fits best at about"),
        (pendulum, 0.0, Decision.MORE_ROUNDS, "Pareto k"),
    ],
)
def test_the_decision_about_a_recording_names_its_cause(model, friction, decision, reason):
    found = diagnosis(model, swinging(rollouts=2, friction=friction))
    assert found.decision is decision, found.reason
    assert reason in found.reason
