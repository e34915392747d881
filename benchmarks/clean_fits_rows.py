"""Reads what a fit wrote, and compares it with the truth."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from npdr_ppl.cli.resolve import resolve_model
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import score
from npdr_ppl.rollouts import Rollouts

__all__ = [
    "discovery_figures",
    "error_figures",
    "fit_figures",
    "named_parameters",
    "parameter_figures",
]

LEVEL = 0.9
"""Probability of the central interval whose coverage is counted."""

JOINT = 0.95
"""Probability that all parameters lie inside their intervals at once, at least: each interval
leaves out 1 - JOINT over their number (Bonferroni)."""

SAME = 1e-6
"""Relative difference of two held-out errors that rounding explains."""


def parameter_figures(
    draws: Mapping[str, np.ndarray],
    truth: Mapping[str, float],
    prior: Mapping[str, tuple[float, float]],
) -> dict[str, dict[str, Any]]:
    """Returns truth, moments and intervals of every parameter.

    Args:
        draws: Posterior draws by parameter, of any shape.
        truth: True values.
        prior: Ends of the uniform priors.
    """
    found = {}
    for name, true in truth.items():
        values = np.asarray(draws[name], dtype=np.float64).ravel()
        low, high = np.quantile(values, [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0])
        tail = 0.5 * (1.0 - JOINT) / len(truth)
        least, most = np.quantile(values, [tail, 1.0 - tail])
        ends = prior[name]
        found[name] = {
            "truth": float(true),
            "mean": float(values.mean()),
            "sd": float(values.std()),
            "low": float(low),
            "high": float(high),
            "is_inside": bool(low <= true <= high),
            "is_inside_jointly": bool(least <= true <= most),
            # Of a uniform prior's standard deviation.
            "width": float(values.std() * np.sqrt(12.0) / (ends[1] - ends[0])),
        }
    return found


def fit_figures(
    out: Path, truth: Mapping[str, float], prior: Mapping[str, tuple[float, float]]
) -> dict[str, Any]:
    """Returns what ``fit.json`` and ``posterior.nc`` in a folder say of the parameters.

    Args:
        out: The folder of the fit.
        truth: True values.
        prior: Ends of the uniform priors.
    """
    fit = json.loads((out / "fit.json").read_text())
    with xr.open_dataset(out / "posterior.nc", group="posterior", engine="h5netcdf") as posterior:
        draws = {name: posterior[name].to_numpy() for name in truth}
    diagnosis = fit["diagnosis"]
    return {
        "parameters": parameter_figures(draws, truth, prior),
        "decision": diagnosis["decision"],
        "reason": diagnosis["reason"],
        "named": named_parameters(diagnosis["reason"], list(truth)),
        "r_hat": diagnosis.get("r_hat"),
        "most_likely": fit["most_likely"],
    }


def named_parameters(reason: str, parameters: Sequence[str]) -> list[str]:
    """Returns the parameters that a sentence names, in its order.

    A parameter may be called mass, and a posterior has mass too: that of a share, or its own.
    """
    told = re.sub(r"\b(its|the|posterior|probability) mass\b", " ", reason)
    places = {
        name: found.start()
        for name in parameters
        if (found := re.search(rf"(?<![\w.]){re.escape(name)}\b", told))
    }
    return sorted(places, key=lambda name: places[name])


def discovery_figures(out: Path) -> dict[str, Any]:
    """Returns verdict and named effects of a ``discovery.json`` in a folder."""
    found = json.loads((out / "discovery.json").read_text())
    effects = [f"{effect['port']}.{effect['effect']}" for effect in found["effects"]]
    return {"verdict": found["verdict"], "effects": effects}


def error_figures(
    model: str,
    holdout: Rollouts,
    out: Path,
    truth: Mapping[str, float],
) -> dict[str, Any]:
    """Returns held-out errors of the posterior's best parameters and of the true ones.

    Both are replayed in the model's own simulator, prepared as the fit was: a coarse integrator
    makes an error of the truth's too.

    Args:
        model: Word that names the model on the command line.
        holdout: The held-out rollouts.
        out: The folder of the fit.
        truth: True values.
    """
    fit = json.loads((out / "fit.json").read_text())
    chosen, options = resolve_model(model), preparation(out)

    def error(parameters: Mapping[str, Any]) -> float:
        values = {n: torch.tensor(v, dtype=torch.float64) for n, v in parameters.items()}
        return float(score(chosen, holdout, values, options)["rmse"].mean())

    best, true = error(fit["most_likely"]), error(truth)
    reported = fit.get("metrics", {}).get("rmse")
    is_same = None if reported is None else abs(best - reported) <= SAME * reported
    return {
        "rmse": best,
        "rmse_truth": true,
        "rmse_ratio": best / true,
        "rmse_reported": reported,
        # If not, the fit prepared the held-out rollouts in another way than it recorded.
        "is_rmse_reproduced": is_same,
    }


def preparation(out: Path) -> DataOptions:
    """Returns how a fit prepared its data, as far as it has written that down."""
    known = {field.name for field in fields(DataOptions)} - {"embedding"}
    recorded: dict[str, Any] = {}
    run = out / "run" / "run.json"
    if run.exists():
        recorded = json.loads(run.read_text()).get("binding", {})
    return DataOptions(**{name: value for name, value in recorded.items() if name in known})
