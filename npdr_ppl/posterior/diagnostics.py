"""Reads an ArviZ object and decides what to do next.

Only the exported object is read, through ArviZ, so a posterior from anywhere can be diagnosed.

The figures: r̂ and effective sample size across chains (independently trained members, or disjoint
draws of a corrected posterior); contraction 1 − sd/sd_prior per parameter, alone and given all
others; coverage and probability integral transform (PIT) of the recording under the posterior
predictive; a Bayesian p-value of the worst segment's error; PSIS-LOO over segments with Pareto k.
Posteriors of this package export the checks of :mod:`npdr_ppl.posterior.exported_checks` as well.

The order of the decisions is that of the evidence. That the model is wrong is decided first, and
only where its best parameters leave what no parameters explain, also with wider priors; then that
a prior ends too early; then that the estimator has not converged; then what the recording does not
determine.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.posterior.diagnostic_values import (
    against_prior,
    conditional_contraction,
    extreme,
    leave_one_out,
    partners,
    predictive_checks,
)
from npdr_ppl.posterior.exported_checks import ATTRIBUTE
from npdr_ppl.posterior.settings import ESTIMATOR_CHECK
from npdr_ppl.preparation.data_options import FEWEST_SEGMENTS

if TYPE_CHECKING:
    from npdr_ppl.arviz_module import Data

__all__ = ["Decision", "Diagnosis", "Thresholds", "diagnose"]


CONDITIONAL_CONTRACTION = 0.5
"""A parameter counts as determined in combination with others if its contraction, given all
others, is at least this. At 0.5 its conditional standard deviation is half that of its prior."""


class Decision(StrEnum):
    """What the caller should do next."""

    ACCEPT = "accept"
    MORE_ROUNDS = "more rounds"
    WIDEN = "widen"
    NEW_ROLLOUT = "new rollout"
    OTHER_EXCITATION = "other excitation"
    REVISE_MODEL = "revise the model"
    STOP = "stop"


@dataclass(frozen=True)
class Thresholds:
    """Limits behind the decisions.

    Attributes:
        r_hat: Chains agree below this (Vehtari et al. 2021 advise 1.01 for MCMC; networks trained
            on the same simulations differ by more).
        ess: Least effective sample size. Five chains at the limit of r̂ have this one. For a
            single chain, it determines the ends of a 90 % interval to half a standard deviation.
        coverage_shortfall: Greatest difference between 0.9 and the share of the recording inside
            the 90 % band.
        segment_p_value: Least p-value of the worst segment.
        noise_ratio: Greatest ratio of the residuals at the best parameters to the declared noise.
            At 1.25 an interval of 90 % holds 81 %.
        edge_mass: Greatest share of a marginal in the outermost 2 % of the prior; above it, the
            prior is too narrow.
        contraction: Least contraction of a parameter that the data determine.
        pareto_k: Greatest Pareto k of a segment for which PSIS-LOO is reliable.
        influential_share: Greatest share of the segments above ``pareto_k``; above it, the
            posterior depends on few of the segments.
    """

    r_hat: float = 1.1
    ess: float = 20.0
    coverage_shortfall: float = 0.2
    segment_p_value: float = 0.01
    noise_ratio: float = 1.25
    edge_mass: float = 0.25
    contraction: float = 0.1
    pareto_k: float = 0.7
    influential_share: float = 0.1


@dataclass(frozen=True)
class Diagnosis:
    """Figures, the decision they lead to, and the sentence that explains it.

    Attributes:
        decision: What to do next.
        reason: One sentence.
        r_hat: Greatest r̂ over all parameters; NaN with a single member.
        ess: Least bulk effective sample size over all parameters.
        contraction: 1 − sd/sd_prior by parameter.
        edge_mass: Share of the posterior at the prior's edges by parameter.
        coverage_90: Share of the recording inside the central 90 % predictive band.
        pit_deviation: Greatest distance of the PIT's distribution from uniform.
        segment_p_value: Bayesian p-value of the worst segment.
        elpd_loo: Expected log predictive density over segments, and its standard error.
        pareto_k: Greatest Pareto k of a segment.
        conditional_contraction: Contraction given all other parameters.
        partners: Of each parameter, the others with which it is strongly correlated.
        influential_share: Share of the segments whose Pareto k is above the limit.
        estimator_k: Pareto k of the posterior's draws, weighted by the simulator's likelihood;
            NaN if it was not computed.
        model_p_value: Probability that the misfit at the best parameters is as large by chance, as
            ``npdr discover`` computes it; NaN if it was not computed.
    """

    decision: Decision
    reason: str
    r_hat: float
    ess: float
    contraction: Mapping[str, float]
    edge_mass: Mapping[str, float]
    coverage_90: float
    pit_deviation: float
    segment_p_value: float
    elpd_loo: tuple[float, float]
    pareto_k: float
    conditional_contraction: Mapping[str, float] = field(default_factory=dict)
    partners: Mapping[str, list[str]] = field(default_factory=dict)
    influential_share: float = float("nan")
    estimator_k: float = float("nan")
    model_p_value: float = float("nan")

    def to_dict(self) -> dict[str, Any]:
        """Returns the figures as JSON-serialisable values."""
        return asdict(self) | {"decision": self.decision.value}


def diagnose(
    data: "Data",
    thresholds: Thresholds | None = None,
    *,
    rounds_left: int = 1,
    rollouts_left: int = 1,
) -> Diagnosis:
    """Diagnoses a posterior and decides what to do next.

    Args:
        data: An ArviZ object as :meth:`npdr_ppl.Posterior.to_arviz` makes it.
        thresholds: Limits behind the decisions.
        rounds_left: Rounds of inference that could still be spent.
        rollouts_left: Rollouts that could still be recorded.

    Raises:
        DataError: A needed group is missing.
    """
    from npdr_ppl.arviz_module import ess, group, group_names, rhat

    limits = thresholds or Thresholds()
    missing = {"posterior", "prior", "posterior_predictive", "observed_data"}
    missing -= set(group_names(data))
    if missing:
        raise DataError(f"The ArviZ object lacks the groups {', '.join(sorted(missing))}.")
    groups = {name: group(data, name) for name in group_names(data)}
    checks: dict[str, Any] = json.loads(data.attrs.get(ATTRIBUTE, "{}"))
    contraction, edge_mass = against_prior(groups)
    coverage, pit_deviation, p_value = predictive_checks(groups)
    elpd, k, influential = leave_one_out(data, limits.pareto_k)
    estimator, model = checks.get("estimator", {}), checks.get("model", {})
    figures = Diagnosis(
        Decision.ACCEPT,
        "",
        extreme(rhat(data), np.nanmax),
        extreme(ess(data), np.nanmin),
        contraction,
        edge_mass,
        coverage,
        pit_deviation,
        p_value,
        elpd,
        k,
        conditional_contraction(groups),
        partners(groups),
        influential,
        _number(estimator.get("pareto_k")),
        _number(model.get("p_value")),
    )
    reads = _Reading(figures, limits, checks, rounds_left, rollouts_left)
    decision, reason = reads.decide()
    return replace(figures, decision=decision, reason=reason)


@dataclass(frozen=True)
class _Reading:
    """Figures, and what they mean together."""

    figures: Diagnosis
    limits: Thresholds
    checks: Mapping[str, Any]
    rounds_left: int
    rollouts_left: int

    def decide(self) -> tuple[Decision, str]:
        """Returns the first decision whose condition holds, and the reason for it."""
        found = (
            self._of_model()
            or self._of_priors()
            or self._of_estimator()
            or self._of_excitation()
            or self._of_influence()
        )
        return found or (Decision.ACCEPT, f"{self._agreement()}{self._undetermined()}")

    @property
    def _shown(self) -> str:
        figures = self.figures
        return (
            f"the 90 % band holds {figures.coverage_90:.0%} of the recording, worst segment "
            f"p = {figures.segment_p_value:.3f}"
        )

    def _agreement(self) -> str:
        model = self.checks.get("model")
        if model is None:
            return f"The chains agree and the posterior explains the recording ({self._shown})."
        if model["p_value"] is None:
            return (
                "The posterior agrees with the simulator. Whether the model lacks an effect was "
                f"not tested: that takes at least {FEWEST_SEGMENTS} segments."
            )
        return (
            "The posterior agrees with the simulator, and the recording shows no disagreement "
            f"with the model (p = {model['p_value']:.2g})."
        )

    def _misfit(self) -> bool:
        """Whether predictions miss the recording; used only if there is no likelihood."""
        figures, limits = self.figures, self.limits
        return (
            0.9 - figures.coverage_90 > limits.coverage_shortfall
            or figures.segment_p_value < limits.segment_p_value
        )

    def _of_model(self) -> tuple[Decision, str] | None:
        model = self.checks.get("model")
        if model is None:
            return self._of_predictions()
        if model["fired"]:
            priors = [f"{text}. " for text in self.checks.get("priors", ())]
            even = "Even with wider priors, no" if priors else "No"
            return (
                Decision.REVISE_MODEL,
                f"{''.join(priors)}{even} parameters explain the recording "
                f"(p = {model['p_value']:.2g} at the best ones, clearest in "
                f"{model['strongest']}): an effect is missing in the model. `npdr discover` looks "
                "for it.",
            )
        ratio = _number(model.get("misfit"))
        if ratio > self.limits.noise_ratio and not self.checks.get("priors"):
            regular = (
                "too few segments to see whether they are regular"
                if model["p_value"] is None
                else "nothing regular in them"
            )
            return (
                Decision.REVISE_MODEL,
                f"The best parameters leave residuals {ratio:.2g} times as large as the declared "
                f"noise, and {regular}: declare more noise, or none to have it estimated.",
            )
        return None

    def _of_predictions(self) -> tuple[Decision, str] | None:
        """Decides about the model by predictions alone, once the estimator has converged."""
        if not self._misfit():
            return None
        if self.figures.r_hat > self.limits.r_hat and self.rounds_left > 0:
            return self._more_rounds()
        at_edge = {n: m for n, m in self.figures.edge_mass.items() if m > self.limits.edge_mass}
        if at_edge:
            worst = max(at_edge, key=lambda name: at_edge[name])
            return (
                Decision.WIDEN,
                f"The posterior presses {worst} against the edge of its prior "
                f"({at_edge[worst]:.0%} of its mass) and still misses the recording "
                f"({self._shown}): widen the prior.",
            )
        return (
            Decision.REVISE_MODEL,
            f"No parameters explain the recording ({self._shown}): an effect is missing in the "
            "model.",
        )

    def _of_priors(self) -> tuple[Decision, str] | None:
        priors = self.checks.get("priors")
        if not priors:
            return None
        return Decision.WIDEN, f"{'. '.join(priors)}."

    def _of_estimator(self) -> tuple[Decision, str] | None:
        figures, limits = self.figures, self.limits
        estimator = self.checks.get("estimator", {"is_reliable": True})
        is_off = not estimator["is_reliable"]
        if not (is_off or figures.r_hat > limits.r_hat or figures.ess < limits.ess):
            return None
        if self.rounds_left > 0:
            return self._more_rounds()
        return (
            Decision.WIDEN,
            f"The estimator has not converged ({self._convergence()}) and no rounds are left: mix "
            "the posterior with the prior.",
        )

    def _more_rounds(self) -> tuple[Decision, str]:
        return (
            Decision.MORE_ROUNDS,
            f"The estimator has not converged ({self._convergence()}): more rounds, more "
            "simulations or other features are needed before the posterior is reliable.",
        )

    def _convergence(self) -> str:
        figures = self.figures
        parts = [f"r-hat {figures.r_hat:.2f}", f"effective sample size {figures.ess:.0f}"]
        estimator = self.checks.get("estimator")
        if estimator is not None and not estimator["is_reliable"]:
            k = _number(estimator["pareto_k"])
            shown = f"{k:.1f}" if np.isfinite(k) else "unknown"
            parts.append(f"Pareto k {shown} against the simulator")
        return ", ".join(parts)

    def _unlearnt(self) -> list[str]:
        return [n for n, c in self.figures.contraction.items() if c < self.limits.contraction]

    def _of_excitation(self) -> tuple[Decision, str] | None:
        unlearnt = self._unlearnt()
        if not unlearnt:
            return None
        everything = len(unlearnt) == len(self.figures.contraction)
        if self.rollouts_left <= 0:
            if not everything:
                return None
            return (
                Decision.STOP,
                "The data determine no parameter "
                f"({_listed(unlearnt)}), and no more can be recorded.",
            )
        alone = [
            n
            for n in unlearnt
            if self.figures.conditional_contraction[n] < CONDITIONAL_CONTRACTION
        ]
        if alone:
            return (
                Decision.NEW_ROLLOUT,
                f"The recording says nothing of {_listed(alone)}: record a rollout that excites "
                "the system more.",
            )
        others = {p for n in unlearnt for p in self.figures.partners.get(n, ())} - set(unlearnt)
        with_them = _listed(sorted(others)) if others else "other parameters"
        return (
            Decision.OTHER_EXCITATION,
            f"The recording determines {_listed(unlearnt)} only in combination with {with_them}: "
            "record another excitation, or fix one of them.",
        )

    def _of_influence(self) -> tuple[Decision, str] | None:
        share = self.figures.influential_share
        if not share > self.limits.influential_share or self.rollouts_left <= 0:
            return None
        estimator = self.checks.get("estimator", {"is_corrected": True})
        least = ESTIMATOR_CHECK.least_effective_share
        if not (estimator["is_corrected"] or estimator["learnt_effective_share"] >= least):
            return None  # the approximation makes the weights uneven, whatever the segments say
        return (
            Decision.NEW_ROLLOUT,
            f"The posterior depends on few segments ({share:.0%} of them have a Pareto k above "
            f"{self.limits.pareto_k}): record another rollout.",
        )

    def _undetermined(self) -> str:
        unlearnt = self._unlearnt()
        return f" It does not determine {_listed(unlearnt)}." if unlearnt else ""


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
