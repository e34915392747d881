"""Charts of a saved posterior: marginals, correlations, predictive bands, and PIT."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.display.reports.charts import bands_chart, marginals_chart, matrix_chart, pit_chart
from npdr_ppl.display.reports.content import ChartPart
from npdr_ppl.drawing.columns import scalar_columns
from npdr_ppl.errors import NpdrError
from npdr_ppl.rollouts import Rollouts

if TYPE_CHECKING:
    import xarray as xr

    from npdr_ppl.arviz_module import Data

__all__ = ["parameter_samples", "posterior_charts", "predictive_charts"]

Array = NDArray[np.float64]

MAX_DRAWS = 2_000
MAX_CORRELATED = 20
"""Maximum number of parameters of a correlation matrix; more labels would be unreadable."""

_TIME = ("time [s]", "step")


def posterior_charts(data: "Data", units: Mapping[str, str]) -> list[ChartPart]:
    """Returns marginals and correlations of an ArviZ object's posterior.

    Args:
        data: An ArviZ object.
        units: Units by parameter.
    """
    from npdr_ppl.arviz_module import group

    posterior, prior = group(data, "posterior"), group(data, "prior")
    samples, before = parameter_samples(posterior), parameter_samples(prior)
    samples = {name: values for name, values in samples.items() if name in before}
    parts = [marginals_chart(samples, before, units)] if samples else []
    if 1 < len(samples) <= MAX_CORRELATED:
        parts.append(matrix_chart(samples))
    return parts


def predictive_charts(data: "Data", run: Path) -> list[ChartPart]:
    """Returns bands of the first recorded rollout, a chart per channel, and the PIT histogram.

    Args:
        data: An ArviZ object.
        run: Folder of the inference run; its recording contains the time step and the units.
    """
    from npdr_ppl.arviz_module import group, group_names

    if not {"posterior_predictive", "observed_data"} <= set(group_names(data)):
        return []
    groups = {name: group(data, name) for name in group_names(data)}
    charts: list[ChartPart] = []
    transforms: list[Array] = []
    for site in (str(name) for name in groups["observed_data"].data_vars):
        measured = np.asarray(groups["observed_data"][site], dtype=float)
        predictive = np.asarray(groups["posterior_predictive"][site], dtype=float)
        predictive = predictive.reshape(-1, *measured.shape)
        below = (predictive < measured).mean(0) + 0.5 * (predictive == measured).mean(0)
        constant = groups.get("constant_data")
        if measured.ndim != 3 or constant is None or f"{site}_mask" not in constant:
            transforms.append(below.ravel())
            continue
        rows = np.asarray(constant[f"{site}_mask"], dtype=bool)
        known = np.asarray(constant[f"{site}_measured"], dtype=bool)
        transforms.append(below[rows][:, known].ravel())
        charts += _bands(site, groups, measured, predictive, rows, known, run)
    return [*charts, pit_chart(np.concatenate(transforms))] if transforms else charts


def parameter_samples(dataset: "xr.Dataset") -> dict[str, Array]:
    """Returns the draws ``(n,)`` of every scalar parameter; vectors are split into elements."""
    draws = {}
    for name in dataset.data_vars:
        values = np.asarray(dataset[name], dtype=float)
        flat = values.reshape(-1, *values.shape[2:])
        draws[str(name)] = flat[:: max(1, len(flat) // MAX_DRAWS)]
    return scalar_columns(draws)


def _bands(
    site: str,
    groups: dict[str, Any],
    measured: Array,
    predictive: Array,
    rows: NDArray[np.bool_],
    known: NDArray[np.bool_],
    run: Path,
) -> list[ChartPart]:
    """Joins the segments of the first rollout in time and draws one chart per channel."""
    constant = groups["constant_data"]
    rollout, start = np.asarray(constant[f"{site}_rollout"]), np.asarray(constant[f"{site}_start"])
    first = [int(s) for s in np.flatnonzero(rollout == rollout[0])]
    first.sort(key=lambda segment: int(start[segment]))
    steps = np.concatenate([start[s] + 1 + np.flatnonzero(rows[s]) for s in first])
    names = [str(name) for name in np.asarray(groups["observed_data"][f"{site}_channel"])]
    time_step, units = _clock(run / f"data_{site}.nc")
    charts = []
    for channel in np.flatnonzero(known):
        name = names[channel]
        unit = units.get(name, "")
        charts.append(
            bands_chart(
                f"bands-{site}-{channel}",
                steps * (time_step or 1.0),
                np.concatenate([measured[s, rows[s], channel] for s in first]),
                np.concatenate([predictive[:, s, rows[s], channel] for s in first], axis=1),
                titles=(_TIME[time_step is None], f"{name} [{unit}]" if unit else name),
            )
        )
    return charts


def _clock(recording: Path) -> tuple[float | None, dict[str, str]]:
    """Returns the time step in seconds and the channels' units, if the recording exists."""
    if not recording.exists():
        return None, {}
    try:
        rollouts = Rollouts.from_netcdf(recording)
    except NpdrError:
        # The report is useful even if the recording is damaged.
        return None, {}
    units = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=False))
    return rollouts.time_step, units
