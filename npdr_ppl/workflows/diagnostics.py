"""Reads an ArviZ object and decides what to do next.

Only the exported object is read, through ArviZ, so a posterior from anywhere can be diagnosed.

The figures: r̂ and effective sample size across independently trained members (disagreement means
the estimator, not the posterior, decides); contraction 1 − sd/sd_prior per parameter; coverage and
probability integral transform (PIT) of the recording under the posterior predictive; a Bayesian
p-value of the worst segment's error; PSIS-LOO over segments with Pareto k.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError

if TYPE_CHECKING:
    import xarray as xr

    from npdr_ppl.workflows.arviz_module import Data

__all__ = ["Decision", "Diagnosis", "Thresholds", "diagnose"]


class Decision(StrEnum):
    """What the caller should do next."""

    ACCEPT = "accept"
    MORE_ROUNDS = "more rounds"
    WIDEN = "widen"
    NEW_ROLLOUT = "new rollout"
    REVISE_MODEL = "revise the model"
    STOP = "stop"


@dataclass(frozen=True)
class Thresholds:
    """Limits behind the decisions.

    Attributes:
        r_hat: Members agree below this (Vehtari et al. 2021 advise 1.01 for MCMC; networks trained
            on the same simulations differ by more).
        coverage_shortfall: The recording leaves its 90 % band by this much more than it should.
        segment_p_value: The worst segment is this unlikely under the posterior predictive.
        edge_mass: Share of a marginal in the outermost 2 % of the prior that makes it too narrow.
        contraction: Every parameter learnt less than this: the data say nothing.
        pareto_k: PSIS-LOO is unreliable above it.
    """

    r_hat: float = 1.1
    coverage_shortfall: float = 0.2
    segment_p_value: float = 0.01
    edge_mass: float = 0.25
    contraction: float = 0.1
    pareto_k: float = 0.7


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
        pareto_k: Greatest Pareto k.
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

    def to_dict(self) -> dict[str, Any]:
        """Returns the figures as JSON-serialisable values."""
        return asdict(self) | {"decision": self.decision.value}


def diagnose(
    data: "Data",
    thresholds: Thresholds | None = None,
    *,
    rounds_left: int = 0,
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
    from npdr_ppl.workflows.arviz_module import ess, group, group_names, rhat

    limits = thresholds or Thresholds()
    missing = {"posterior", "prior", "posterior_predictive", "observed_data"}
    missing -= set(group_names(data))
    if missing:
        raise DataError(f"The ArviZ object lacks the groups {', '.join(sorted(missing))}.")
    groups = {name: group(data, name) for name in group_names(data)}
    least_ess = _extreme(ess(data), np.nanmin)
    r_hat = _extreme(rhat(data), np.nanmax)
    contraction, edge_mass = _against_prior(groups)
    coverage, pit_deviation, p_value = _predictive_checks(groups)
    elpd, k = _loo(data)
    decision, reason = _decide(
        limits,
        rounds_left,
        rollouts_left,
        r_hat,
        contraction,
        edge_mass,
        coverage,
        p_value,
    )
    return Diagnosis(
        decision,
        reason,
        r_hat,
        least_ess,
        contraction,
        edge_mass,
        coverage,
        pit_deviation,
        p_value,
        elpd,
        k,
    )


def _decide(
    limits: Thresholds,
    rounds_left: int,
    rollouts_left: int,
    r_hat: float,
    contraction: Mapping[str, float],
    edge_mass: Mapping[str, float],
    coverage: float,
    p_value: float,
) -> tuple[Decision, str]:
    misfit = 0.9 - coverage > limits.coverage_shortfall or p_value < limits.segment_p_value
    shown = f"the 90 % band holds {coverage:.0%} of the recording, worst segment p = {p_value:.3f}"
    if r_hat > limits.r_hat and rounds_left > 0:
        return (
            Decision.MORE_ROUNDS,
            f"The ensemble members disagree (r-hat {r_hat:.2f} > {limits.r_hat}), so more "
            "simulations are needed before the posterior can be believed.",
        )
    at_edge = {name: mass for name, mass in edge_mass.items() if mass > limits.edge_mass}
    if misfit and at_edge:
        worst = max(at_edge, key=lambda name: at_edge[name])
        return (
            Decision.WIDEN,
            f"The posterior presses {worst} against the edge of its prior ({at_edge[worst]:.0%} "
            f"of its mass) and still misses the recording ({shown}): widen the prior.",
        )
    if misfit:
        return (
            Decision.REVISE_MODEL,
            f"No parameters explain the recording ({shown}): an effect is missing in the model.",
        )
    if contraction and max(contraction.values()) < limits.contraction:
        learnt = f"The data contract no parameter by more than {max(contraction.values()):.0%}"
        if rollouts_left > 0:
            return (
                Decision.NEW_ROLLOUT,
                f"{learnt}: record a rollout that excites the system more.",
            )
        return Decision.STOP, f"{learnt}, and no more can be recorded."
    if r_hat > limits.r_hat:
        return (
            Decision.WIDEN,
            f"The ensemble members still disagree (r-hat {r_hat:.2f} > {limits.r_hat}) and no "
            "rounds are left: mix the posterior with the prior.",
        )
    return (
        Decision.ACCEPT,
        f"The members agree and the posterior explains the recording ({shown}).",
    )


def _extreme(dataset: Any, reduce: Any) -> float:
    values = [np.asarray(dataset[name]).ravel() for name in dataset.data_vars]
    joined = np.concatenate(values)
    return float(reduce(joined)) if np.isfinite(joined).any() else float("nan")


def _against_prior(
    data: Mapping[str, "xr.Dataset"],
) -> tuple[dict[str, float], dict[str, float]]:
    contraction, edge_mass = {}, {}
    for name in data["posterior"].data_vars:
        posterior = np.asarray(data["posterior"][name]).reshape(
            -1, *data["posterior"][name].shape[2:]
        )
        prior = np.asarray(data["prior"][name]).reshape(-1, *posterior.shape[1:])
        labels = (
            [str(name)]
            if posterior.ndim == 1
            else [
                f"{name}[{','.join(map(str, index))}]" for index in np.ndindex(posterior.shape[1:])
            ]
        )
        columns = zip(
            labels,
            posterior.reshape(len(posterior), -1).T,
            prior.reshape(len(prior), -1).T,
            strict=True,
        )
        for label, q, p in columns:
            contraction[label] = float(1 - q.std() / max(p.std(), np.finfo(float).tiny))
            low, high = np.quantile(p, [0.01, 0.99])
            edge_mass[label] = float(np.mean(q < low) + np.mean(q > high))
    return contraction, edge_mass


def _predictive_checks(data: Mapping[str, "xr.Dataset"]) -> tuple[float, float, float]:
    coverages, deviations, p_values = [], [], []
    for name in data["observed_data"].data_vars:
        observed = np.asarray(data["observed_data"][name])
        predictive = np.asarray(data["posterior_predictive"][name])
        predictive = predictive.reshape(-1, *observed.shape)
        counted = _counted(data, str(name), observed.shape)
        # Without any spread of its own, a deterministic simulator's draws are compared as ranks.
        pit = (predictive < observed).mean(0) + 0.5 * (predictive == observed).mean(0)
        pit = pit[counted]
        coverages.append(float(np.mean((pit >= 0.05) & (pit <= 0.95))))
        grid = np.sort(pit)
        uniform = (np.arange(len(grid)) + 0.5) / len(grid)
        deviations.append(float(np.abs(grid - uniform).max()))
        p_values.append(_worst_segment_p_value(predictive, observed, counted))
    return min(coverages), max(deviations), min(p_values)


def _counted(
    data: Mapping[str, "xr.Dataset"], name: str, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Returns which readings exist and were measured."""
    if "constant_data" not in data or f"{name}_mask" not in data["constant_data"]:
        return np.ones(shape, dtype=bool)
    mask = np.asarray(data["constant_data"][f"{name}_mask"])[..., None]
    measured = np.asarray(data["constant_data"][f"{name}_measured"])
    return np.broadcast_to(mask & measured, shape)


def _worst_segment_p_value(
    predictive: NDArray[np.float64], observed: NDArray[np.float64], counted: NDArray[np.bool_]
) -> float:
    """Returns how often a draw's segment is as far from the mean as the worst recorded one.

    Discrepancy: the greatest over segments of the mean squared distance from the predictive
    mean, in units of the predictive variance; with the draws themselves as replicates.
    """
    mean = predictive.mean(0)
    scale = predictive.std(0)
    floor = 1e-3 * np.abs(observed).max() + np.finfo(float).tiny
    weight = counted / np.maximum(scale, floor) ** 2
    axes = tuple(range(observed.ndim))[-2:] if observed.ndim >= 3 else None

    def discrepancy(value: NDArray[np.float64]) -> float:
        return float(np.max(((value - mean) ** 2 * weight).sum(axis=axes)))

    replicated = np.array([discrepancy(draw) for draw in predictive])
    return float(np.mean(replicated >= discrepancy(observed)))


def _loo(data: "Data") -> tuple[tuple[float, float], float]:
    from npdr_ppl.workflows.arviz_module import group, group_names, loo

    unknown = (float("nan"), float("nan")), float("nan")
    if "log_likelihood" not in group_names(data):
        return unknown
    if len(group(data, "log_likelihood").data_vars) != 1:
        return unknown
    found = loo(data)
    return (found.elpd, found.se), float(np.max(found.pareto_k))
