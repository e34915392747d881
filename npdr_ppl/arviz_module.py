"""The only module that imports ArviZ; it hides the differences between ArviZ releases.

Up to 0.23 ArviZ keeps its groups in an ``InferenceData``, from 1.0 on in xarray's ``DataTree``.
Function arguments and table columns differ too. The functions here have one signature and one
meaning for both, and all other modules use only them. Results are named as in ArviZ 1. Defaults
that differ between the releases (the kind and probability of intervals, the rounding of tables)
are always given explicitly.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike, NDArray

with warnings.catch_warnings():
    # ArviZ 0.23 announces its next major release on every import.
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.hdf5_checks import check_self_contained

__all__ = [
    "HAS_DATATREE",
    "Data",
    "Loo",
    "az",
    "compare",
    "ess",
    "ess_of_array",
    "from_dict",
    "from_netcdf",
    "group",
    "group_names",
    "hdi",
    "loo",
    "pareto_smoothed",
    "rhat",
    "summary",
    "to_netcdf",
]

HAS_DATATREE: bool = int(az.__version__.split(".")[0]) >= 1
"""Whether this ArviZ keeps groups in a ``DataTree``."""

FEWEST_WEIGHTS = 25
"""Minimum number of weights for fitting a Pareto distribution: a fifth of them form its tail, and
its shape needs five."""

EQUAL_LOG_WEIGHTS = 1e-6
"""Greatest difference between log weights that count as equal: rounding of a double-precision
simulation. A Pareto distribution cannot be fitted to their tail."""

# A type checker sees only the installed release and does not know the other release's names.
_az: Any = az

Data = Any
"""ArviZ's collection of groups: an ``InferenceData`` up to 0.23, a ``DataTree`` from 1.0 on."""

_SUMMARY = ["mean", "sd", "hdi_lb", "hdi_ub"]
_SUMMARY += ["mcse_mean", "mcse_sd", "ess_bulk", "ess_tail", "r_hat"]


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
        arguments: dict[str, Any] = {
            "coords": dict(coords or {}),
            "dims": {k: list(v) for k, v in (dims or {}).items()},
            "skip_event_dims": name == "log_likelihood",
        }
        if "data" in name:
            arguments["sample_dims" if HAS_DATATREE else "default_dims"] = []
        dataset = _az.dict_to_dataset(dict(values), **arguments)
        for variable, own in (variable_attrs or {}).get(name, {}).items():
            dataset[variable].attrs.update(own)
        datasets[name] = dataset
    if HAS_DATATREE:
        tree = xr.DataTree.from_dict(datasets)
        tree.attrs = dict(attrs or {})
        return tree
    with _any_group():
        return _az.InferenceData(attrs=dict(attrs or {}), **datasets)


def group_names(data: Data) -> list[str]:
    """Returns the names of the groups."""
    return list(data.children) if HAS_DATATREE else list(data.groups())


def group(data: Data, name: str) -> xr.Dataset:
    """Returns a group.

    Raises:
        DataError: There is no group of that name.
    """
    if name not in group_names(data):
        raise DataError(f"The ArviZ object has no group {name!r}; it has {group_names(data)}.")
    return data[name].to_dataset() if HAS_DATATREE else data[name]


def hdi(data: Data, prob: float, *, group_name: str = "posterior") -> xr.Dataset:
    """Returns highest-density intervals, along the dimension ``ci_bound`` (lower, upper).

    Args:
        data: An ArviZ object.
        prob: Probability of the intervals.
        group_name: The group.
    """
    samples = group(data, group_name)
    if HAS_DATATREE:
        return _az.hdi(samples, prob=prob)
    intervals = _az.hdi(samples, hdi_prob=prob).rename(hdi="ci_bound")
    return intervals.assign_coords(ci_bound=["lower", "upper"])


def rhat(data: Data) -> xr.Dataset:
    """Returns rank-normalised split r̂ of the posterior's variables; NaN with a single chain."""
    samples = group(data, "posterior")
    if samples.sizes["chain"] < 2:
        return xr.full_like(samples.isel(chain=0, draw=0, drop=True), np.nan, dtype=float)
    return _az.rhat(samples)


def ess(data: Data, *, method: Literal["bulk", "tail", "mean"] = "bulk") -> xr.Dataset:
    """Returns the effective sample size of the posterior's variables."""
    return _az.ess(group(data, "posterior"), method=method)


def ess_of_array(chains: NDArray[np.floating[Any]], *, method: Literal["bulk", "mean"]) -> float:
    """Returns the effective sample size of one quantity, ``(chains, draws)``."""
    return float(_az.ess(chains, method=method))


def summary(data: Data, *, prob: float = 0.94) -> pd.DataFrame:
    """Returns a table of the posterior's scalar parameters, unrounded.

    Args:
        data: An ArviZ object.
        prob: Probability of the highest-density intervals.

    Returns:
        Columns mean, sd, hdi_lb, hdi_ub, mcse_mean, mcse_sd, ess_bulk, ess_tail, r_hat.
    """
    samples = group(data, "posterior")
    if HAS_DATATREE:
        table = _az.summary(samples, ci_prob=prob, ci_kind="hdi", round_to="none")
    else:
        table = _az.summary(samples, hdi_prob=prob, round_to="none")
    bounds = [c for c in table.columns if str(c).startswith("hdi")]
    table = table.rename(columns=dict(zip(bounds, ("hdi_lb", "hdi_ub"), strict=True)))
    return pd.DataFrame({column: table[column].astype(float) for column in _SUMMARY})


def loo(data: Data, *, var_name: str | None = None) -> Loo:
    """Estimates the expected log predictive density by PSIS-LOO.

    Args:
        data: An ArviZ object with a ``log_likelihood``.
        var_name: Variable of that group; needed if it has several.
    """
    with _quiet_loo():
        found = _az.loo(_judged_draws(data), pointwise=True, var_name=var_name)
    names = ("elpd", "p", "elpd_i") if HAS_DATATREE else ("elpd_loo", "p_loo", "loo_i")
    elpd, p, elpd_i = (getattr(found, name) for name in names)
    elpd_i = np.asarray(elpd_i)
    # ArviZ 1 divides by n - 1, ArviZ 0.x by n; the difference matters with few segments.
    se = float(np.sqrt(elpd_i.size * elpd_i.var(ddof=1))) if elpd_i.size > 1 else float("nan")
    return Loo(float(elpd), se, float(p), np.asarray(found.pareto_k), elpd_i)


def compare(models: Mapping[str, Data], *, var_name: str | None = None) -> pd.DataFrame:
    """Compares models by PSIS-LOO, best first, with stacking weights.

    Args:
        models: ArviZ objects by name.
        var_name: Variable of ``log_likelihood``; needed if there are several.

    Returns:
        Columns rank, elpd, p, elpd_diff (to the best, so at most 0), weight, se, dse, unrounded,
        and warning: whether a Pareto k is too large to trust the row.
    """
    names: dict[str, Any] = {"var_name": var_name, "method": "stacking"}
    judged = {name: _judged_draws(data) for name, data in models.items()}
    with _quiet_loo():
        # ArviZ 0.23 calls pandas in ways that pandas 3 deprecates.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="arviz")
        if HAS_DATATREE:
            table = _az.compare(judged, round_to="none", **names)
            table["warning"] = table["diag_elpd"].fillna("").ne("")
        else:
            table = _az.compare(judged, ic="loo", scale="log", **names)
            table = table.rename(columns={"elpd_loo": "elpd", "p_loo": "p"})
            table["elpd_diff"] = 0.0 - table["elpd_diff"]
    n = loo(next(iter(models.values())), var_name=var_name).elpd_i.size
    for column in ("se", "dse"):  # as in loo
        if n == 1:
            table[column] = np.nan
        elif not HAS_DATATREE:
            table[column] *= np.sqrt(n / (n - 1))
    columns = ("rank", "elpd", "p", "elpd_diff", "weight", "se", "dse", "warning")
    return pd.DataFrame({column: table[column] for column in columns})


def _judged_draws(data: Data) -> Data:
    """Returns the draws that have log likelihoods, which may be only the first ones.

    ArviZ divides the effective sample size of the whole posterior by the number of log
    likelihoods. Draws without one would make ArviZ fit the tails of the weights to too few draws.
    """
    likelihood, posterior = group(data, "log_likelihood"), group(data, "posterior")
    kept = {
        "posterior": posterior.isel(draw=slice(0, likelihood.sizes["draw"])),
        "log_likelihood": likelihood,
    }
    return xr.DataTree.from_dict(kept) if HAS_DATATREE else _az.InferenceData(**kept)


def to_netcdf(data: Data, path: str | PathLike[str]) -> None:
    """Writes an ArviZ object as NetCDF; either release reads the other's files."""
    if HAS_DATATREE:
        tree = data
    else:
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
    try:
        check_self_contained(path)
        if HAS_DATATREE:
            with xr.open_datatree(fspath(path), engine="h5netcdf") as tree:
                return tree.load()
        with _any_group(), _az.rc_context({"data.load": "eager"}):
            return _az.from_netcdf(fspath(path), engine="h5netcdf")
    except DataError as error:
        raise DataError(f"{fspath(path)}: {error}") from None
    # Decoders raise nearly any error for corrupt bytes.
    except Exception as error:
        raise DataError(
            f"{fspath(path)} is not a readable NetCDF file ({type(error).__name__})."
        ) from error


@contextmanager
def _any_group() -> Iterator[None]:
    """Permits groups that are not in ArviZ 0.x's scheme, such as ArviZ 1's ``prior_sbc``."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not defined in the InferenceData scheme")
        yield


@contextmanager
def _quiet_loo() -> Iterator[None]:
    """Silences warnings about large Pareto k, which the caller gets as numbers or a flag."""
    with warnings.catch_warnings():
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
    if HAS_DATATREE:
        from arviz_stats.base import array_stats  # pyright: ignore[reportMissingImports]

        smoothed, k = array_stats.psislw(values[is_used])
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # k is returned, and the caller judges it
            smoothed, k = _az.psislw(values[is_used])
    result[is_used] = np.asarray(smoothed, dtype=float)
    return result, float(np.asarray(k))
