"""Writes the parameters of a finished run into the robot's own file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from pyro import poutine
from torch import Tensor

from npdr_ppl.engines.mujoco.export import ExportedMjcf, export_mjcf
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.handlers import SkipSimulation, add_effect, with_finer_steps
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.program_runs import alone, sample_sites, traced
from npdr_ppl.language.sites import BlackBox, SimulatorBlackBox
from npdr_ppl.models.effects import effect_class
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DiscoveryRecord, FitRecord

__all__ = ["export_robot", "identified"]


def identified(run: Path) -> tuple[dict[str, float], int]:
    """Returns posterior means by site, and how often steps were refined, of a finished run.

    Args:
        run: Folder of a fit or a discovery.

    Raises:
        DataError: The folder holds neither, or a parameter is not a number.
    """
    if (run / "fit.json").is_file():
        found: Mapping[str, Any] = read_json(run / "fit.json", FitRecord)
    elif (run / "discovery.json").is_file():
        found = read_json(run / "discovery.json", DiscoveryRecord)
    else:
        raise DataError(f"{run} is no folder of a finished npdr fit or npdr discover.")
    values = {}
    for name, interval in found.get("parameters", {}).items():
        if not isinstance(interval["mean"], int | float):
            raise DataError(f"{name} is not a single number, so no file can hold it.")
        values[name] = float(interval["mean"])
    if not values:
        raise DataError(f"{run} has no parameters; let npdr discover run to its end.")
    return values, int(found.get("finer_steps") or 0)


def export_robot(
    model: Callable[..., Any], values: Mapping[str, float], *, finer_steps: int = 0
) -> ExportedMjcf:
    """Writes values of a model's sites into the MJCF file of its simulator.

    Effects that the values name, as ``<port>.<effect>.<parameter>``, are added to the model first.

    Args:
        model: A Pyro model with one simulator, a ``MujocoSimulator`` of a file.
        values: Values by site.
        finer_steps: How often the simulator's steps were refined.

    Raises:
        ModelError: The model has another simulator, or the file cannot hold a parameter.
    """
    known = {effect.name for effect in _box(model, {}).simulator.effects}
    for name in dict.fromkeys(site.rpartition(".")[0] for site in values if "." in site):
        if name not in known:
            port, _, effect = name.rpartition(".")
            model = add_effect(model, effect_class(effect)(port))
    for _ in range(finer_steps):
        model = with_finer_steps(model)
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    box = _box(model, given)
    if not isinstance(box.simulator, MujocoMechanism):
        raise ModelError(f"{box.simulator.name} has no MJCF file.")
    return export_mjcf(box.simulator, box.parameters)


def _box(model: Callable[..., Any], values: Mapping[str, Tensor]) -> SimulatorBlackBox:
    """Returns the simulator of a model, at given values of all sites.

    Args:
        model: The model.
        values: Values by site; if there are none, they are drawn from the priors.

    Raises:
        ModelError: There is not one simulator, or the sites are not those that are given.
    """
    with alone(), torch.random.fork_rng(devices=[]), SkipSimulation():
        trace = traced(poutine.condition(model, data=dict(values)), (_nothing(),))
    sites = dict(sample_sites(trace))
    boxes = [site["fn"] for site in sites.values() if isinstance(site["fn"], BlackBox)]
    if len(boxes) != 1 or not isinstance(boxes[0], SimulatorBlackBox):
        raise ModelError("A robot's file is written for models with one simulator.")
    latent = {name for name, site in sites.items() if not isinstance(site["fn"], BlackBox)}
    other = sorted(latent ^ values.keys()) if values else []
    if other:
        raise ModelError(
            f"{other[0]} is a parameter of only one of model and run; give the model of the run."
        )
    return boxes[0]


def _nothing() -> Inputs:
    """Returns inputs without channels: the model's program runs, and nothing is simulated."""
    return Inputs.single(
        torch.zeros(1, 0), torch.zeros(0), action_names=(), state_names=(), time_step=1.0
    )
