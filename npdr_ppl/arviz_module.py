"""The only module that imports ArviZ, release 0.23; all other modules use its functions.

ArviZ 1 has other containers, arguments and column names. Results here are named as in ArviZ 1.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike, NDArray

with warnings.catch_warnings():
    # ArviZ 0.23 announces its next major release on every import.
    warnings.simplefilter("ignore", FutureWarning)
    import arviz

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.hdf5_checks import check_self_contained, named_netcdf

__all__ = [
    "Data",
    "Loo",
    "compare",
    "ess",
    "ess_of_mean",
    "from_dict",
    "from_netcdf",
    "group",
    "group_names",
    "hdi",
    "loo",
    "pareto_smoothed",
    "rhat",
    "to_netcdf",
]

FEWEST_WEIGHTS = 25
"""Minimum number of weights for fitting a Pareto distribution: a fifth of them form its tail, and
its shape needs five."""

EQUAL_LOG_WEIGHTS = 1e-6
"""Greatest difference between log weights that count as equal: rounding of a double-precision
simulation. A Pareto distribution cannot be fitted to their tail."""

LARGEST_GAP = 350.0
"""Range of the log weights in a tail above which its shape counts as infinite. It is half of what
double precision represents; ArviZ's fit overflows at twice this and may then call the tail
reliable."""

az: Any = arviz  # its annotations do not tell a dataset from an array

Data = arviz.InferenceData
"""ArviZ's collection of groups."""


@dataclass(frozen=True)
class Loo:
    """Leave-one-out cross-validation by Pareto-smoothed importance sampling.

    Attributes:
        elpd: Expected log pointwise predictive density.
        se: Its standard error; NaN with a single observation.
        p: Effective number of parameters.
        pareto_k: Tail index of every observation's weights.
        elpd_i: Contribution of every observation to ``elpd``.
    """

    elpd: float
    se: float
    p: float
    pareto_k: NDArray[np.float64]
    elpd_i: NDArray[np.float64]


def from_dict(
    groups: Mapping[str, Mapping[str, ArrayLike]],
    *,
    coords: Mapping[str, Sequence[Any] | NDArray[Any]] | None = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    attrs: Mapping[str, Any] | None = None,
    variable_attrs: Mapping[str, Mapping[str, Mapping[str, Any]]] | None = None,
) -> Data:
    """Makes an ArviZ object.

    Args:
        groups: Arrays by group and variable. Those of groups with ``data`` in their name have no
            sample dimensions; all others are ``(chain, draw, ...)``.
        coords: Labels by dimension.
        dims: Names of the dimensions after the sample dimensions, by variable.
        attrs: Attributes of the whole object.
        variable_attrs: Attributes by group and variable, e.g. the unit.
    """
    datasets = {}
    for name, values in groups.items():
        dataset = az.dict_to_dataset(
            dict(values),
            coords=dict(coords or {}),
            dims={k: list(v) for k, v in (dims or {}).items()},
            default_dims=[] if "data" in name else None,
            skip_event_dims=name == "log_likelihood",
        )
        for variable, own in (variable_attrs or {}).get(name, {}).items():
            dataset[variable].attrs.update(own)
        datasets[name] = dataset
    with _any_group():
        return az.InferenceData(attrs=dict(attrs or {}), **datasets)


def group_names(data: Data) -> list[str]:
    """Returns the names of the groups."""
    return list(data.groups())


def group(data: Data, name: str) -> xr.Dataset:
    """Returns a group.

    Raises:
        DataError: There is no group of that name.
    """
    if name not in group_names(data):
        raise DataError(f"The ArviZ object has no group {name!r}; it has {group_names(data)}.")
    return data[name]


def hdi(data: Data, prob: float) -> xr.Dataset:
    """Returns the posterior's highest-density intervals along ``ci_bound`` (lower, upper).

    Args:
        data: An ArviZ object.
        prob: Probability of the intervals.
    """
    intervals = az.hdi(group(data, "posterior"), hdi_prob=prob).rename(hdi="ci_bound")
    return intervals.assign_coords(ci_bound=["lower", "upper"])


def rhat(data: Data) -> xr.Dataset:
    """Returns rank-normalised split r̂ of the posterior's variables; NaN with a single chain."""
    samples = group(data, "posterior")
    if samples.sizes["chain"] < 2:
        return xr.full_like(samples.isel(chain=0, draw=0, drop=True), np.nan, dtype=float)
    return az.rhat(samples)


def ess(data: Data) -> xr.Dataset:
    """Returns the bulk effective sample size of the posterior's variables."""
    return az.ess(group(data, "posterior"), method="bulk")


def ess_of_mean(chains: NDArray[np.floating[Any]]) -> float:
    """Returns the effective sample size for the mean of one quantity, ``(chains, draws)``."""
    return float(az.ess(chains, method="mean"))


def loo(data: Data, *, var_name: str | None = None) -> Loo:
    """Estimates the expected log predictive density by PSIS-LOO.

    Args:
        data: An ArviZ object with a ``log_likelihood``.
        var_name: Variable of that group; needed if it has several.
    """
    judged = _judged_draws(data)
    with _quiet_loo():
        found = az.loo(judged, pointwise=True, var_name=var_name)
    elpd_i = np.asarray(found.loo_i)
    # ArviZ divides by n instead of n - 1; the difference matters with few segments.
    se = float(np.sqrt(elpd_i.size * elpd_i.var(ddof=1))) if elpd_i.size > 1 else float("nan")
    likelihoods = judged["log_likelihood"]
    weights = -likelihoods[var_name or next(iter(likelihoods.data_vars))]
    weights = weights.stack(every=("chain", "draw")).transpose("every", ...)
    is_representable = _tail_gap(weights.to_numpy()) <= LARGEST_GAP
    k = np.where(is_representable, np.asarray(found.pareto_k), np.inf)
    return Loo(float(found.elpd_loo), se, float(found.p_loo), k, elpd_i)


def compare(models: Mapping[str, Data], *, var_name: str | None = None) -> pd.DataFrame:
    """Compares models by PSIS-LOO, best first, with stacking weights.

    Args:
        models: ArviZ objects by name.
        var_name: Variable of ``log_likelihood``; needed if there are several.

    Returns:
        Columns rank, elpd, p, elpd_diff (to the best, so at most 0), weight, se, dse, unrounded,
        and warning: whether a Pareto k is too large to trust the row.
    """
    judged = {name: _judged_draws(data) for name, data in models.items()}
    with _quiet_loo():
        # ArviZ calls pandas in ways that pandas 3 deprecates.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="arviz")
        table = az.compare(judged, ic="loo", scale="log", method="stacking", var_name=var_name)
    table = table.rename(columns={"elpd_loo": "elpd", "p_loo": "p"})
    table["elpd_diff"] = 0.0 - table["elpd_diff"]
    judgements = {name: loo(data, var_name=var_name) for name, data in models.items()}
    unreliable = [bool(np.isinf(judgements[name].pareto_k).any()) for name in table.index]
    table["warning"] = table["warning"] | np.array(unreliable)
    n = next(iter(judgements.values())).elpd_i.size
    for column in ("se", "dse"):  # as in loo
        table[column] *= np.sqrt(n / (n - 1)) if n > 1 else np.nan
    columns = ("rank", "elpd", "p", "elpd_diff", "weight", "se", "dse", "warning")
    return pd.DataFrame({column: table[column] for column in columns})


def _judged_draws(data: Data) -> Data:
    """Returns the draws that have log likelihoods, which may be only the first ones.

    ArviZ divides the effective sample size of the whole posterior by the number of log
    likelihoods. Draws without one would make ArviZ fit the tails of the weights to too few draws.
    """
    likelihood, posterior = group(data, "log_likelihood"), group(data, "posterior")
    return az.InferenceData(
        posterior=posterior.isel(draw=slice(0, likelihood.sizes["draw"])),
        log_likelihood=likelihood,
    )


def to_netcdf(data: Data, path: str | PathLike[str]) -> None:
    """Writes an ArviZ object as NetCDF."""
    tree = xr.DataTree.from_dict({name: data[name] for name in data.groups()})
    tree.attrs = data.attrs
    # HDF5 crashes if the disk is full while it writes to a file.
    content = tree.to_netcdf(engine="h5netcdf")
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def from_netcdf(path: str | PathLike[str]) -> Data:
    """Reads an ArviZ object into memory and closes the file.

    Raises:
        DataError: The file is damaged, or takes data from another file.
    """
    with named_netcdf(path):
        check_self_contained(path)
        with _any_group(), az.rc_context({"data.load": "eager"}):
            return az.from_netcdf(fspath(path), engine="h5netcdf")


@contextmanager
def _any_group() -> Iterator[None]:
    """Permits groups that are not in ArviZ's scheme, such as ``prior_sbc``."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not defined in the InferenceData scheme")
        yield


@contextmanager
def _quiet_loo() -> Iterator[None]:
    """Silences warnings about large Pareto k, which the caller gets as numbers or a flag."""
    # Of weights hundreds of orders of magnitude apart, quotients overflow; see LARGEST_GAP.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # With a single observation, its value equals the sum, about which ArviZ warns.
        warnings.filterwarnings("ignore", message="The point-wise LOO is the same with the sum")
        warnings.filterwarnings("ignore", message=".*shape parameter of Pareto distribution")
        # A plain function's output counts as one observation.
        warnings.filterwarnings("ignore", message="The point-wise LOO is the same")
        yield


def pareto_smoothed(log_weights: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """Smooths the largest importance weights with a generalised Pareto distribution.

    Args:
        log_weights: Log weights of n draws, ``(n,)``; minus infinity for draws without weight.

    Returns:
        Normalised log weights ``(n,)`` and the distribution's shape k. It is infinite if fewer
        than ``FEWEST_WEIGHTS`` draws have a weight, and zero if all weights are equal.

    References:
        A. Vehtari, D. Simpson, A. Gelman, Y. Yao and J. Gabry, Pareto smoothed importance
        sampling, 2024.
    """
    values = np.asarray(log_weights, dtype=float)
    is_used = np.isfinite(values)
    result = np.full(values.shape, -np.inf)
    if int(is_used.sum()) < FEWEST_WEIGHTS:
        return result, float("inf")
    if is_used.all() and np.ptp(values) <= EQUAL_LOG_WEIGHTS:
        return np.full(values.shape, -np.log(values.size)), 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # k is returned, and the caller judges it
        smoothed, k = az.psislw(values[is_used])
    result[is_used] = np.asarray(smoothed, dtype=float)
    is_representable = _tail_gap(values[is_used]) <= LARGEST_GAP
    return result, float(np.asarray(k)) if is_representable else math.inf


def _tail_gap(log_weights: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Returns the range of the log weights in the tail that is fitted, along the first axis.

    The tail has the largest min(n / 5, 3 √n) of n weights (Vehtari et al. 2024).
    """
    num = len(log_weights)
    first = num - math.ceil(min(0.2 * num, 3.0 * math.sqrt(num)))
    ordered = np.sort(log_weights, axis=0)
    return ordered[-1] - ordered[first]
