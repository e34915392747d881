"""Table 2: fitted on some rollouts, judged on the others, and returns measured on a rig."""

import json

import numpy as np
import pytest

from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import nominal_parameters, score
from npdr_ppl.reproduction.table2 import SEGMENT_LENGTH, reproduce_table2
from npdr_ppl.rollouts import Rollouts

METHOD = "bayesian-linear-regression"
"""The quickest of the paper's methods; it simulates nothing."""

HELD_OUT = (1, 3)
DISTURBANCE = 5.0
"""Standard deviation of what is added to held-out velocities, rad/s: a fifth of their range."""


@pytest.fixture(scope="module")
def recording():
    """Swing-ups of a rig in MuJoCo; those to be held out have velocities that no model follows."""
    target, rng = furuta_target("furuta-easy"), np.random.default_rng(0)
    policy, steps = FurutaSwingUp(), 3 * SEGMENT_LENGTH
    readings, actions = [], []
    for index in range(4):
        found = target.run(policy.controller(Furuta().nominal()), steps, seed=index)
        noise = rng.standard_normal(found.readings[0].shape) * [0.0, 0.0, 1.0, 1.0]
        readings.append(found.readings[0] + (index in HELD_OUT) * DISTURBANCE * noise)
        actions.append(found.actions[0])
    return Rollouts.from_arrays(
        readings=readings, actions=actions, channel_names=found.channel_names,
        action_names=found.action_names, time_step=found.time_step,
    )  # fmt: skip


@pytest.fixture(scope="module")
def table(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("table2")
    comparison, result = reproduce_table2(
        recording, out, holdout=HELD_OUT, backends=[METHOD], progress=False
    )
    return comparison, result, out


@pytest.mark.slow
def test_methods_are_judged_on_the_rollouts_that_were_held_out(recording, table):
    comparison, result, _ = table
    figures = comparison.rows[METHOD].figures
    # Noise marks the rollouts: only those that were held out have more than a model can
    # follow.
    options = DataOptions("all/50", SEGMENT_LENGTH, "recorded", "float64")
    fitted = recording[[i for i in range(4) if i not in HELD_OUT]]
    on_fitted = score(furuta, fitted, figures.most_likely, options)["rmse"]
    on_held_out = score(furuta, recording[list(HELD_OUT)], figures.most_likely, options)["rmse"]
    assert min(on_held_out) > 2 * max(on_fitted)
    assert list(figures.rmse) == pytest.approx(on_held_out.tolist(), rel=1e-6)
    assert result["rows"][METHOD]["rmse"]["mean"] == pytest.approx(float(on_held_out.mean()))
    assert len(figures.elpd) == 3 * len(HELD_OUT)
    assert result["held_out"] == list(HELD_OUT)
    assert comparison.settings["evaluated_on"] == "held-out"


@pytest.mark.slow
def test_held_out_rollouts_have_no_say_in_the_fit(recording, table, tmp_path):
    comparison, _, _ = table
    readings = [r.copy() for r in recording.readings]
    for index in HELD_OUT:
        readings[index] = readings[index] * 1.5
    other = Rollouts.from_arrays(
        readings=readings, actions=recording.actions, channel_names=recording.channel_names,
        action_names=recording.action_names, time_step=recording.time_step,
    )  # fmt: skip
    again, _ = reproduce_table2(
        other, tmp_path, holdout=HELD_OUT, backends=[METHOD], progress=False
    )
    assert again.rows[METHOD].parameters == comparison.rows[METHOD].parameters
    assert again.rows[METHOD].figures.rmse != comparison.rows[METHOD].figures.rmse


@pytest.mark.slow
def test_nominal_parameters_are_judged_on_every_rollout(recording, table):
    _, result, _ = table
    options = DataOptions("all/50", SEGMENT_LENGTH, "recorded", "float64")
    nominal = nominal_parameters(furuta, recording.inputs(SEGMENT_LENGTH))
    every = score(furuta, recording, nominal, options)
    for metric in ("rmse", "dtw"):
        row = result["rows"]["nominal"][metric]
        assert row["mean"] == pytest.approx(float(every[metric].mean()))
        assert row["std"] == pytest.approx(float(every[metric].std(correction=0)))


@pytest.mark.slow
def test_what_is_written_is_what_is_returned(table):
    _, result, out = table
    written = json.loads((out / "table2.json").read_text())
    assert set(written) == set(result)
    for part in ("rows", "paper", "failed", "held_out", "initial_state"):
        assert written[part] == result[part]
