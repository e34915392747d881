"""The figures that a diagnosis rests on, read off an ArviZ object; see `diagnostics`."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

    from npdr_ppl.arviz_module import Data

__all__ = [
    "against_prior",
    "conditional_contraction",
    "extreme",
    "leave_one_out",
    "partners",
    "predictive_checks",
]

FEWEST_FOR_INFLUENCE = 8
"""Least number of segments for the share of influential ones. With fewer segments, each one is
influential."""

STRONG_CORRELATION = 0.7
"""Rank correlation from which half of a parameter's variance follows from the other one."""


def conditional_contraction(groups: Mapping[str, "xr.Dataset"]) -> dict[str, float]:
    """Returns 1 − sd/sd_prior of every parameter given all others, to second order."""
    labels, posterior = _columns(groups["posterior"])
    _, prior = _columns(groups["prior"])
    spread = np.maximum(prior.std(0), np.finfo(float).tiny)
    covariance = np.atleast_2d(np.cov(posterior / spread, rowvar=False))
    precision = np.linalg.pinv(covariance + 1e-12 * np.eye(len(labels)), hermitian=True)
    conditional = 1.0 / np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    return {name: float(1.0 - sd) for name, sd in zip(labels, conditional, strict=True)}


def partners(groups: Mapping[str, "xr.Dataset"]) -> dict[str, list[str]]:
    """Returns the others with which each parameter is strongly correlated, by rank."""
    labels, posterior = _columns(groups["posterior"])
    ranks = posterior.argsort(0).argsort(0)
    correlation = np.atleast_2d(np.corrcoef(ranks, rowvar=False))
    return {
        name: [
            other
            for other, value in zip(labels, row, strict=True)
            if other != name and abs(value) > STRONG_CORRELATION
        ]
        for name, row in zip(labels, correlation, strict=True)
    }


def _columns(dataset: "xr.Dataset") -> tuple[list[str], NDArray[np.float64]]:
    """Returns every scalar's label and draws, ``(draws, scalars)``."""
    labels: list[str] = []
    columns = []
    for name in dataset.data_vars:
        values = np.asarray(dataset[name], dtype=float)
        shape = values.shape[2:]
        labels += [
            f"{name}[{','.join(map(str, index))}]" if shape else str(name)
            for index in np.ndindex(shape)
        ]
        columns.append(values.reshape(values.shape[0] * values.shape[1], -1))
    return labels, np.concatenate(columns, axis=1)


def extreme(dataset: Any, reduce: Callable[[NDArray[np.float64]], Any]) -> float:
    """Returns an extreme of all finite values of a dataset; NaN where there is none."""
    values = [np.asarray(dataset[name]).ravel() for name in dataset.data_vars]
    joined = np.concatenate(values)
    return float(reduce(joined)) if np.isfinite(joined).any() else float("nan")


def against_prior(
    groups: Mapping[str, "xr.Dataset"],
) -> tuple[dict[str, float], dict[str, float]]:
    """Returns contraction and mass at the prior's edges of every scalar."""
    labels, posterior = _columns(groups["posterior"])
    _, prior = _columns(groups["prior"])
    contraction, edge_mass = {}, {}
    for label, q, p in zip(labels, posterior.T, prior.T, strict=True):
        contraction[label] = float(1 - q.std() / max(p.std(), np.finfo(float).tiny))
        low, high = np.quantile(p, [0.01, 0.99])
        edge_mass[label] = float(np.mean(q < low) + np.mean(q > high))
    return contraction, edge_mass


def predictive_checks(data: Mapping[str, "xr.Dataset"]) -> tuple[float, float, float]:
    """Compares the recording with the posterior predictive; of several sites, the worst counts.

    Returns:
        Share of the recording inside the central 90 % band; greatest distance of the PIT's
        distribution from uniform; Bayesian p-value of the worst segment.
    """
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
    """Returns the share of draws with a segment as far from the mean as the worst recorded one.

    The distance is the mean squared difference from the predictive mean, in units of the
    predictive variance.
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


def leave_one_out(data: "Data", limit: float) -> tuple[tuple[float, float], float, float]:
    """Returns elpd with its error, the greatest Pareto k, and the share of those above a limit."""
    from npdr_ppl.arviz_module import group, group_names, loo

    unknown = (float("nan"), float("nan")), float("nan"), float("nan")
    if "log_likelihood" not in group_names(data):
        return unknown
    if len(group(data, "log_likelihood").data_vars) != 1:
        return unknown
    found = loo(data)
    k = np.asarray(found.pareto_k)
    share = float(np.mean(k > limit)) if k.size >= FEWEST_FOR_INFLUENCE else float("nan")
    return (found.elpd, found.se), float(np.max(k)), share
