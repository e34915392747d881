"""Each decision is taken for the reason it should be, from the ArviZ object alone."""

import json

import numpy as np
import pytest
import xarray as xr

import npdr_ppl as npdr
from npdr_ppl.arviz_module import from_dict, group, group_names
from npdr_ppl.errors import DataError
from npdr_ppl.posterior.diagnostic_values import partners
from npdr_ppl.posterior.diagnostics import Decision, Thresholds

SEGMENTS, STEPS = 4, 25


def exported(
    *,
    sd=0.1,
    centre=1.0,
    prior=(0.0, 2.0),
    members_differ=0.0,
    misfit=0.0,
    seed=0,
    segments=SEGMENTS,
    influential=0,
    persistence=0.0,
    checks=None,
):
    """An ArviZ object of a constant signal ``x(t) = level`` observed with noise 0.05.

    Args:
        sd: Standard deviation of the posterior.
        centre: Its mean.
        prior: Ends of the uniform prior.
        members_differ: Difference between the means of both chains.
        misfit: What is added to the end of the second segment.
        seed: Seed of the draws.
        segments: Number of segments.
        influential: Number of segments that decide about the posterior alone.
        persistence: Correlation of a draw with the one before it.
        checks: Checks that the export holds besides.
    """
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal((2, 400))
    for k in range(1, 400):
        normal[:, k] *= (1.0 - persistence**2) ** 0.5
        normal[:, k] += persistence * normal[:, k - 1]
    level = centre + sd * normal
    level[1] += members_differ
    level = np.clip(level, *prior)
    noise = 0.05 * rng.standard_normal((2, 400, segments, STEPS, 1))
    observed = 1.0 + 0.05 * rng.standard_normal((segments, STEPS, 1))
    observed[1] += misfit * np.linspace(0, 1, STEPS)[:, None]
    predictive = level[..., None, None, None] + noise
    likelihood = -0.5 * ((observed - level[..., None, None, None]) / 0.05) ** 2
    likelihood = likelihood.mean((-1, -2))
    likelihood[..., :influential] -= 20.0 * rng.standard_exponential((2, 400, influential)) ** 2
    data = from_dict(
        {
            "posterior": {"level": level},
            "prior": {"level": rng.uniform(*prior, (1, 400))},
            "posterior_predictive": {"x": predictive},
            "observed_data": {"x": observed},
            "constant_data": {
                "x_mask": np.ones((segments, STEPS), dtype=bool),
                "x_measured": np.array([True]),
            },
            "log_likelihood": {"x": likelihood},
        }
    )
    if checks is not None:
        data.attrs["checks"] = json.dumps(checks)
    return data


def test_a_good_posterior_is_accepted():
    found = npdr.diagnose(exported(sd=0.02))
    assert found.decision is Decision.ACCEPT
    assert found.r_hat < 1.05
    assert found.contraction["level"] > 0.9
    assert np.isfinite(found.elpd_loo[0])
    # 100 correlated readings, one draw of the noise each: three standard errors around 0.9.
    assert abs(found.coverage_90 - 0.9) < 0.1


def test_members_that_disagree_want_more_rounds_and_the_prior_when_there_are_none():
    data = exported(sd=0.02, members_differ=0.1)
    found = npdr.diagnose(data, rounds_left=2)
    assert found.decision is Decision.MORE_ROUNDS
    assert "r-hat" in found.reason
    # It is not the effective sample size alone that says so.
    assert npdr.diagnose(data, Thresholds(ess=0.0)).decision is Decision.MORE_ROUNDS
    found = npdr.diagnose(data, rounds_left=0)
    assert found.decision is Decision.WIDEN
    assert "no rounds are left" in found.reason


def test_a_posterior_at_the_edge_that_misses_the_data_is_widened():
    found = npdr.diagnose(exported(sd=0.01, centre=0.5, prior=(0.0, 0.5)))
    assert found.decision is Decision.WIDEN
    assert "level" in found.reason


def test_data_that_no_parameters_explain_call_for_another_model():
    found = npdr.diagnose(exported(sd=0.02, misfit=1.0))
    assert found.decision is Decision.REVISE_MODEL
    assert found.segment_p_value < 0.01


def test_data_that_say_nothing_call_for_another_rollout():
    found = npdr.diagnose(exported(sd=0.6, prior=(0.0, 2.0)))
    assert found.contraction["level"] < 0.3
    strict = npdr.diagnose(exported(sd=0.6), Thresholds(contraction=0.5))
    assert strict.decision is Decision.NEW_ROLLOUT
    last = npdr.diagnose(exported(sd=0.6), Thresholds(contraction=0.5), rollouts_left=0)
    assert last.decision is Decision.STOP
    assert "no more can be recorded" in last.reason


def test_a_decision_is_taken_once_the_reasons_before_it_are_excluded():
    model = {"p_value": 1e-4, "fired": True, "strongest": "drag", "misfit": 3.0}
    prior = "length fits best at 0.2, beyond the lower end of its prior: widen the prior"
    estimator = {"pareto_k": 2.0, "is_reliable": False, "is_corrected": True}
    wrong = {"sd": 0.5, "members_differ": 1.0}

    def decided(model, priors, estimator, *, rounds_left=1, rollouts_left=1, limits=None, **data):
        checks = {"model": model, "priors": priors, "estimator": estimator}
        data = {"segments": 10, "influential": 3, **data}
        found = npdr.diagnose(
            exported(checks=checks, **data),
            limits or Thresholds(contraction=0.5),
            rounds_left=rounds_left,
            rollouts_left=rollouts_left,
        )
        return found.decision, found.reason

    decision, reason = decided(model, [prior], estimator, **wrong)
    assert decision is Decision.REVISE_MODEL
    # A prior that ends too early is said first, whatever else is missing.
    assert reason.startswith(f"{prior}. Even with wider priors, no parameters explain")
    assert "clearest in drag" in reason
    assert decided(model, [], estimator, **wrong)[1].startswith("No parameters explain")
    # Residuals that are too large are a narrow prior's fault before they are the noise's.
    silent = {**model, "fired": False}
    assert decided(silent, [prior], estimator, **wrong) == (Decision.WIDEN, f"{prior}.")
    decision, reason = decided(silent, [], estimator, **wrong)
    assert decision is Decision.REVISE_MODEL and "3 times as large as the declared" in reason
    right = {**silent, "misfit": 1.2}
    # A recording that is too short for the test says nothing about the model.
    short = {**right, "p_value": None, "strongest": ""}
    reliable = {**estimator, "pareto_k": 0.1, "is_reliable": True}
    decision, reason = decided(short, [], reliable, sd=0.02, misfit=1.0, influential=0)
    assert decision is Decision.ACCEPT and "was not tested: that takes at least 8" in reason
    reason = decided({**short, "misfit": 3.0}, [], reliable, sd=0.02)[1]
    assert "too few segments to see whether they are regular" in reason
    decision, reason = decided(right, [], estimator, **wrong)
    assert decision is Decision.MORE_ROUNDS and "Pareto k 2.0 against the simulator" in reason
    decision, reason = decided(right, [], estimator, rounds_left=0, **wrong)
    assert decision is Decision.WIDEN and "no rounds are left" in reason
    reliable = {**estimator, "pareto_k": 0.1, "is_reliable": True}
    decision, reason = decided(right, [], reliable, **wrong)
    assert decision is Decision.MORE_ROUNDS and "r-hat" in reason and "Pareto" not in reason
    decision, reason = decided(right, [], reliable, sd=0.5)
    assert decision is Decision.NEW_ROLLOUT and "says nothing of level" in reason
    decision, reason = decided(right, [], reliable, sd=0.02)
    assert decision is Decision.NEW_ROLLOUT
    assert "depends on few segments (30% of them have a Pareto k above 0.7)" in reason
    assert decided(right, [], reliable, sd=0.02, rollouts_left=0)[0] is Decision.ACCEPT
    assert decided(right, [], reliable, sd=0.02, influential=0)[0] is Decision.ACCEPT
    # A learnt posterior that is only nearly right has uneven weights in any case.
    learnt = {**reliable, "is_corrected": False, "learnt_effective_share": 0.9}
    assert decided(right, [], learnt, sd=0.02)[0] is Decision.ACCEPT
    learnt["learnt_effective_share"] = 0.995
    assert decided(right, [], learnt, sd=0.02)[0] is Decision.NEW_ROLLOUT
    # Each of fewer segments is influential.
    few = {"segments": 7, "influential": 2}
    assert decided(right, [], reliable, sd=0.02, **few)[0] is Decision.ACCEPT


@pytest.mark.parametrize("influential", [0, 1, 2])
def test_segments_that_decide_about_the_posterior_alone_are_counted(influential):
    found = npdr.diagnose(exported(sd=0.02, segments=10, influential=influential))
    assert found.influential_share == pytest.approx(influential / 10)
    assert (found.pareto_k > 0.7) == (influential > 0)
    # One segment of ten may be influential.
    expected = Decision.NEW_ROLLOUT if influential > 1 else Decision.ACCEPT
    assert found.decision is expected, found.reason


def test_chains_that_agree_but_hardly_move_want_more_rounds():
    data = exported(sd=0.02, persistence=0.98)
    loose = Thresholds(r_hat=10.0)
    found = npdr.diagnose(data, loose)
    assert found.ess < 20.0
    assert found.decision is Decision.MORE_ROUNDS and "effective sample size" in found.reason
    assert npdr.diagnose(data, Thresholds(r_hat=10.0, ess=1.0)).decision is Decision.ACCEPT


def test_predictions_that_miss_in_all_segments_or_in_one_are_a_misfit():
    everywhere = exported(sd=0.02, centre=1.06)
    loose = Thresholds(coverage_shortfall=1.0, segment_p_value=0.0)
    found = npdr.diagnose(everywhere)
    assert found.decision is Decision.REVISE_MODEL and found.coverage_90 < 0.7
    # Either of the two figures is enough; without both the posterior is accepted.
    by_coverage = npdr.diagnose(everywhere, Thresholds(segment_p_value=0.0))
    assert by_coverage.decision is Decision.REVISE_MODEL
    assert npdr.diagnose(everywhere, loose).decision is Decision.ACCEPT
    # One segment of four misses; the band still holds more than 70 % of the recording.
    one = exported(sd=0.02, misfit=0.2)
    found = npdr.diagnose(one)
    assert found.decision is Decision.REVISE_MODEL and found.coverage_90 > 0.7
    assert found.segment_p_value < 0.01


def test_figures_are_json():
    figures = npdr.diagnose(exported(sd=0.02)).to_dict()
    assert json.loads(json.dumps(figures))["decision"] == "accept"


def test_missing_groups_are_named():
    whole = exported()
    data = from_dict(
        {
            name: {k: v.values for k, v in group(whole, name).data_vars.items()}
            for name in group_names(whole)
            if name != "posterior_predictive"
        }
    )
    with pytest.raises(DataError, match="posterior_predictive"):
        npdr.diagnose(data)


def test_the_partners_of_a_parameter_are_those_it_is_strongly_correlated_with():
    rng = np.random.default_rng(0)
    arm, mass = rng.normal(size=(2, 1, 500))
    inertia = np.exp(arm + 0.1 * rng.normal(size=(1, 500)))
    values = {"arm": arm, "inertia": inertia, "mass": mass}
    posterior = xr.Dataset({name: (("chain", "draw"), draws) for name, draws in values.items()})
    found = partners({"posterior": posterior})
    assert found == {"arm": ["inertia"], "inertia": ["arm"], "mass": []}
