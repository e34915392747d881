"""Draws of a finished run's posterior, with units and intervals, for use elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.discovery_result import DRAWS
from npdr_ppl.errors import DataError
from npdr_ppl.posterior.robot_file import identified
from npdr_ppl.run_files import load_tensors, read_json, reading_back
from npdr_ppl.run_records import DiscoveryRecord, FitRecord

__all__ = ["RunDraws", "run_draws"]


@dataclass(frozen=True)
class RunDraws:
    """What a finished run knows of its parameters.

    Attributes:
        means: Posterior means by site, in the parameters' units.
        sds: Posterior standard deviations.
        intervals: Ends of the shortest intervals with a probability of 94 %.
        units: Units, where they are known.
        values: Draws, ``(n, parameters)``, in the order of the means.
        source: The command that made the run, ``"fit"`` or ``"discover"``.
    """

    means: dict[str, float]
    sds: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    units: dict[str, str]
    values: NDArray[np.float64]
    source: str

    @property
    def correlations(self) -> NDArray[np.float64]:
        """Correlations of the draws, ``(parameters, parameters)``; 0 for a constant parameter."""
        centred = self.values - self.values.mean(axis=0)
        spread = centred.std(axis=0)
        scaled = centred / np.where(spread > 0.0, spread, 1.0)
        result = scaled.T @ scaled / len(scaled)
        np.fill_diagonal(result, 1.0)
        return result


def run_draws(run: Path, num: int) -> RunDraws:
    """Returns what a finished run knows of its parameters.

    Args:
        run: Folder of a fit or a discovery.
        num: Most draws to return, evenly spaced among those of the run.

    Raises:
        DataError: The folder holds neither, a parameter is not a number, or there are no draws.
    """
    means = identified(run).values
    is_fit = (run / "fit.json").is_file()
    found = _record(run, is_fit)
    file = run / ("posterior.nc" if is_fit else DRAWS)
    if not file.is_file():
        raise DataError(
            f"{run} has no {file.name}, so it has no draws; run npdr "
            f"{'fit' if is_fit else 'discover'} again, in another folder."
        )
    columns = _of_fit(file) if is_fit else _of_discovery(file)
    missing = [name for name in means if name not in columns]
    if missing:
        raise DataError(f"{file} has no draws of {', '.join(missing)}; it is of another run.")
    if len({len(columns[name]) for name in means}) != 1:
        raise DataError(f"{file} is damaged: it has more draws of some parameters than of others.")
    values = np.stack([columns[name] for name in means], axis=-1)
    if not np.isfinite(values).all():
        raise DataError(f"{file} has draws that are not finite.")
    chosen = np.unique(np.linspace(0, len(values) - 1, min(num, len(values))).round().astype(int))
    with reading_back(run):
        records: dict[str, Any] = dict(found["parameters"])
        sds = {name: float(records[name]["sd"]) for name in means}
        intervals = {
            name: (float(records[name]["hdi_94"][0]), float(records[name]["hdi_94"][1]))
            for name in means
        }
        units = dict(found.get("units") or {})
        for effect in found.get("effects") or []:
            own = f"{effect['port']}.{effect['effect']}"
            for name, record in (effect.get("parameters") or {}).items():
                units.setdefault(f"{own}.{name}", record.get("unit", ""))
        units |= {n: records[n]["unit"] for n in means if records[n].get("unit")}
    units = {name: unit for name, unit in units.items() if name in means and unit}
    return RunDraws(means, sds, intervals, units, values[chosen], "fit" if is_fit else "discover")


def _record(run: Path, is_fit: bool) -> Mapping[str, Any]:
    if is_fit:
        return read_json(run / "fit.json", FitRecord)
    return read_json(run / "discovery.json", DiscoveryRecord)


def _of_fit(file: Path) -> dict[str, NDArray[np.float64]]:
    """Returns the draws of all chains by parameter, of scalar parameters."""
    from npdr_ppl.arviz_module import from_netcdf, group

    posterior = group(from_netcdf(file), "posterior")
    result = {}
    for name, values in posterior.data_vars.items():
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 2:  # chain and draw
            result[str(name)] = array.reshape(-1)
    return result


def _of_discovery(file: Path) -> dict[str, NDArray[np.float64]]:
    return {name: value.numpy().astype(float) for name, value in load_tensors(file).items()}
