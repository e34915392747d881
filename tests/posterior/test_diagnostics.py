"""Each decision is taken for the reason it should be, from the ArviZ object alone."""

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.arviz_module import from_dict, group, group_names
from npdr_ppl.errors import DataError
from npdr_ppl.posterior.diagnostics import Decision, Thresholds

SEGMENTS, STEPS = 4, 25


def exported(*, sd=0.1, centre=1.0, prior=(0.0, 2.0), members_differ=0.0, misfit=0.0, seed=0):
    """An ArviZ object of a constant signal ``x(t) = level`` observed with noise 0.05."""
    rng = np.random.default_rng(seed)
    level = centre + sd * rng.standard_normal((2, 400))
    level[1] += members_differ
    level = np.clip(level, *prior)
    noise = 0.05 * rng.standard_normal((2, 400, SEGMENTS, STEPS, 1))
    observed = 1.0 + 0.05 * rng.standard_normal((SEGMENTS, STEPS, 1))
    observed[1] += misfit * np.linspace(0, 1, STEPS)[:, None]
    predictive = level[..., None, None, None] + noise
    likelihood = -0.5 * ((observed - level[..., None, None, None]) / 0.05) ** 2
    return from_dict(
        {
            "posterior": {"level": level},
            "prior": {"level": rng.uniform(*prior, (1, 400))},
            "posterior_predictive": {"x": predictive},
            "observed_data": {"x": observed},
            "constant_data": {
                "x_mask": np.ones((SEGMENTS, STEPS), dtype=bool),
                "x_measured": np.array([True]),
            },
            "log_likelihood": {"x": likelihood.mean((-1, -2))},
        }
    )


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


def test_figures_are_json():
    import json

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
