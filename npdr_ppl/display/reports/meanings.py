"""Diagnostics in plain language: what a number measures, and what its value means."""

import math
from collections.abc import Mapping
from typing import Any

from npdr_ppl.display.reports.content import Explained, Headline, Tone
from npdr_ppl.drawing.effect_names import in_words
from npdr_ppl.drawing.numbers import number
from npdr_ppl.posterior.diagnostics import Decision, Thresholds

__all__ = ["decision_verdict", "findings"]

MIN_ESS = 400
"""Minimum number of effective draws for accurate intervals (Vehtari et al. 2021)."""

SMALL_PIT_DEVIATION = 0.15
"""Distance from uniform that a few hundred correlated measurements often have by chance."""

_TONES: Mapping[str, Tone] = {
    Decision.ACCEPT: "good",
    Decision.MORE_ROUNDS: "warn",
    Decision.OTHER_EXCITATION: "warn",
    Decision.WIDEN: "warn",
    Decision.NEW_ROLLOUT: "warn",
    Decision.REVISE_MODEL: "bad",
    Decision.STOP: "bad",
}


def decision_verdict(diagnosis: Mapping[str, Any]) -> Headline:
    """Returns the verdict of a diagnosis, in the format of ``fit.json``."""
    word = str(diagnosis.get("decision", "no decision"))
    reason = in_words(str(diagnosis.get("reason", ""))).replace("`", "")
    return Headline(word, reason, _TONES.get(word, "plain"))


def findings(diagnosis: Mapping[str, Any]) -> list[Explained]:
    """Returns the numbers of a diagnosis with their meaning."""
    limits = Thresholds()
    return [
        *_against_simulator(diagnosis, limits),
        *_convergence(diagnosis, limits),
        *_prediction(diagnosis, limits),
        *_against_prior(diagnosis, limits),
        *_leaving_out(diagnosis, limits),
    ]


def _against_simulator(diagnosis: Mapping[str, Any], limits: Thresholds) -> list[Explained]:
    """Returns the checks of model and estimator by the simulator, if they were made."""
    result = []
    p_value, k = _value(diagnosis, "model_p_value"), _value(diagnosis, "estimator_k")
    if not math.isnan(p_value):
        is_missing = diagnosis.get("decision") == Decision.REVISE_MODEL
        result.append(
            Explained(
                "what no parameters explain",
                f"p = {p_value:.2g}",
                "bad" if is_missing else "good",
                "Residuals at the best parameters are systematic: an effect is missing."
                if is_missing
                else "Residuals at the best parameters are not systematic.",
            )
        )
    if not math.isnan(k):
        is_right = k <= limits.pareto_k
        result.append(
            Explained(
                "posterior against the simulator, Pareto k",
                number(k, ".2f"),
                "good" if is_right else "warn",
                f"The simulator gives the draws even weights (limit {limits.pareto_k})."
                if is_right
                else "The simulator gives a few draws most of the weight: the estimator has not "
                "converged.",
            )
        )
    return result


def _convergence(diagnosis: Mapping[str, Any], limits: Thresholds) -> list[Explained]:
    r_hat, ess = _value(diagnosis, "r_hat"), _value(diagnosis, "ess")
    if math.isnan(r_hat):
        agreement = Explained(
            "r̂ across members",
            "–",
            "plain",
            "Only one estimator was trained, so its agreement with another one is not known.",
        )
    elif r_hat <= limits.r_hat:
        agreement = Explained(
            "r̂ across members",
            number(r_hat, ".2f"),
            "good",
            f"Independently trained estimators give the same posterior (limit {limits.r_hat}).",
        )
    else:
        agreement = Explained(
            "r̂ across members",
            number(r_hat, ".2f"),
            "warn",
            f"Independently trained estimators disagree (limit {limits.r_hat}): the result "
            "depends on the estimator, not only on the data. More simulations or rounds help.",
        )
    draws = Explained(
        "Effective sample size",
        number(ess, ".0f"),
        "good" if ess >= MIN_ESS else "warn",
        "Number of independent draws behind the intervals. "
        + ("Enough." if ess >= MIN_ESS else f"Below {MIN_ESS}, interval ends are inaccurate."),
    )
    return [agreement, draws]


def _prediction(diagnosis: Mapping[str, Any], limits: Thresholds) -> list[Explained]:
    coverage = _value(diagnosis, "coverage_90")
    p_value = _value(diagnosis, "segment_p_value")
    pit = _value(diagnosis, "pit_deviation")
    lost = 0.9 - coverage > limits.coverage_shortfall
    unlikely = p_value < limits.segment_p_value
    wide = coverage > 0.98
    return [
        Explained(
            "Coverage of the 90 % band",
            number(coverage, ".0%"),
            "bad" if lost else "good",
            "Share of measurements inside the central 90 % of the predictions. "
            + (
                "Far too few: the model cannot reproduce the device."
                if lost
                else "More than 90 %: predictive intervals are wide."
                if wide
                else "As expected."
            ),
        ),
        Explained(
            "Worst segment, p-value",
            number(p_value, ".3f"),
            "bad" if unlikely else "good",
            "Probability that the fitted model itself deviates as much as the recording does in "
            "its worst segment. "
            + (
                "Very small: an effect is missing, at least there."
                if unlikely
                else "Large enough: no segment is suspicious."
            ),
        ),
        Explained(
            "Deviation of the PIT",
            number(pit, ".2f"),
            "good" if pit <= SMALL_PIT_DEVIATION else "warn",
            "Largest distance between the distribution of the measurements' ranks within the "
            "predictions and a uniform one. "
            + (
                "Small."
                if pit <= SMALL_PIT_DEVIATION
                else "Not small: predictions are too wide, too narrow or shifted; see the "
                "histogram."
            ),
        ),
    ]


def _against_prior(diagnosis: Mapping[str, Any], limits: Thresholds) -> list[Explained]:
    contraction = _numbers(diagnosis, "contraction")
    edges = _numbers(diagnosis, "edge_mass")
    result = []
    if contraction:
        unlearnt = [name for name, value in contraction.items() if value < limits.contraction]
        nothing = len(unlearnt) == len(contraction)
        tone: Tone = "bad" if nothing else "warn" if unlearnt else "good"
        result.append(
            Explained(
                "Contraction",
                f"{min(contraction.values()):.0%} … {max(contraction.values()):.0%}",
                tone,
                "How much narrower the posterior of a parameter is than its prior (0 %: equal, "
                "100 %: known exactly). "
                + (
                    f"The data contain little information about {', '.join(unlearnt)}; record a "
                    "rollout that excites the system more."
                    if unlearnt
                    else "The data contain information about every parameter."
                ),
            )
        )
    if edges:
        pressed = [name for name, mass in edges.items() if mass > limits.edge_mass]
        result.append(
            Explained(
                "Mass at the prior's edge",
                f"{max(edges.values()):.0%}",
                "warn" if pressed else "good",
                "Share of the posterior in the outermost 2 % of the prior. "
                + (
                    f"The prior limits {', '.join(pressed)}: widen the prior, or check whether it "
                    "compensates for a missing effect."
                    if pressed
                    else "No parameter is at the edge of its prior."
                ),
            )
        )
    return result


def _leaving_out(diagnosis: Mapping[str, Any], limits: Thresholds) -> list[Explained]:
    elpd = diagnosis.get("elpd_loo") or [None, None]
    k = _value(diagnosis, "pareto_k")
    if elpd[0] is None:
        return []
    if math.isnan(k):
        trust = "Whether the estimate can be trusted is not known (no Pareto k)."
    elif k <= limits.pareto_k:
        trust = f"Pareto k is {k:.2f}: the estimate can be trusted."
    else:
        trust = (
            f"Pareto k is {k:.2f} (limit {limits.pareto_k}): one segment is so influential that "
            "the estimate cannot be trusted; use held-out rollouts instead."
        )
    return [
        Explained(
            "elpd by PSIS-LOO",
            f"{number(elpd[0], '.1f')} ± {number(elpd[1], '.1f')}",
            "plain" if k <= limits.pareto_k else "warn",
            "Log predictive density of each segment when it is left out. Larger is better; only "
            f"compare values of models on the same data. {trust}",
        )
    ]


def _value(diagnosis: Mapping[str, Any], name: str) -> float:
    value = diagnosis.get(name)
    return float(value) if isinstance(value, int | float) else math.nan


def _numbers(diagnosis: Mapping[str, Any], name: str) -> dict[str, float]:
    values = diagnosis.get(name) or {}
    return {key: float(value) for key, value in values.items() if value is not None}
