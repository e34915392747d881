"""Writes the parameters of a finished run into the robot's own file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.mujoco.export import ExportedMjcf, export_mjcf
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.urdf_export import export_urdf
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import add_effect, num_finer_steps, with_finer_steps
from npdr_ppl.language.only_simulator import only_simulator
from npdr_ppl.models.effects import effect_class, effects
from npdr_ppl.posterior.run_folder import MAX_FINER_STEPS
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DiscoveryRecord, FitRecord

__all__ = [
    "Identified",
    "export_robot",
    "found_effect",
    "found_mechanism",
    "identified",
    "revised_model",
]


class Identified(NamedTuple):
    """What a finished run found.

    Attributes:
        values: Posterior means by site.
        finer_steps: How often the simulator's steps were refined, those of the model included.
        time_step: Seconds per step of the recording; ``None`` if the run does not say.
        verdict: The verdict of a discovery, ``""`` of a fit.
        reason: The reason for it.
        ripples: Ripples per turn of effects that a discovery found, by the effect's name.
    """

    values: dict[str, float]
    finer_steps: int
    time_step: float | None
    verdict: str = ""
    reason: str = ""
    ripples: Mapping[str, int] = MappingProxyType({})


def identified(run: Path) -> Identified:
    """Returns what a finished run found.

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
        mean = interval.get("mean")
        if not isinstance(mean, int | float):
            raise DataError(f"{name} is not a single number, so no file can hold it.")
        values[name] = float(mean)
    if not values:
        raise DataError(f"{run} has no parameters; let npdr discover run to its end.")
    prepared = found.get("preparation") or {}
    length, seconds = prepared.get("segment_length"), prepared.get("segment_seconds")
    step = float(seconds) / float(length) if length and seconds else None
    finer_steps = int(found.get("finer_steps") or 0)
    verdict, reason = (str(found.get(key) or "") for key in ("verdict", "reason"))
    ripples = {
        f"{effect['port']}.{effect['effect']}": int(order)
        for effect in found.get("effects") or []
        if (order := (effect.get("constants") or {}).get("order")) is not None
    }
    return Identified(values, finer_steps, step, verdict, reason, ripples)


def found_effect(name: str, port: str) -> Effect:
    """Returns an effect that a run added to its model.

    Args:
        name: Its id.
        port: Its port.

    Raises:
        ModelError: The effect is neither of the catalogue nor added by the user.
    """
    if name not in effects():
        raise ModelError(
            f"The run has the effect {port}.{name}, which is not in the catalogue. If you have "
            "its file, give it, as in --effect learned_effect.py:Class@port."
        )
    return effect_class(name)(port)


def revised_model(model: Callable[..., Any], found: Identified) -> Callable[..., Any]:
    """Returns a model with the effects that a run's values name, and the run's steps.

    Args:
        model: A Pyro model with one simulator.
        found: What the run found.
    """
    _, sites = only_simulator(model)
    for name in dict.fromkeys(s.rpartition(".")[0] for s in found.values if s not in sites):
        port, _, effect = name.rpartition(".")
        if port:
            added = found_effect(effect, port)
            if name in found.ripples:
                added = added.with_ripples(found.ripples[name])
            model = add_effect(model, added)
    finer = found.finer_steps - num_finer_steps(model)
    for _ in range(min(finer, MAX_FINER_STEPS)):
        model = with_finer_steps(model)
    return model


def found_mechanism(
    model: Callable[..., Any], found: Identified
) -> tuple[MujocoMechanism, Mapping[str, Tensor]]:
    """Returns the simulator of a run's model, effects attached, and its parameters' values.

    Args:
        model: A Pyro model with one simulator, a ``MujocoSimulator``.
        found: What the run found.

    Raises:
        ModelError: The model has another simulator, or other parameters than the run.
    """
    model = revised_model(model, found)
    given = {n: torch.tensor(value, dtype=torch.float64) for n, value in found.values.items()}
    box, sites = only_simulator(model, given)
    other = sorted(sites ^ given.keys())
    if other:
        raise ModelError(
            f"{other[0]} is a parameter of only one of model and run; give the model of the run."
        )
    if not isinstance(box.simulator, MujocoMechanism):
        raise ModelError(f"{box.simulator.name} has no MJCF file.")
    return box.simulator, box.parameters


def export_robot(
    model: Callable[..., Any], found: Identified, name: str | None = None
) -> ExportedMjcf:
    """Writes a run's values into the MJCF or URDF file of its model's simulator.

    Effects of the catalogue that the values name, as ``<port>.<effect>.<parameter>``, are added to
    the model first.

    Args:
        model: A Pyro model with one simulator, a ``MujocoSimulator`` of a file.
        found: What the run found.
        name: Name of the new file; that of the robot's file by default. With the ending
            ``.urdf`` it is a URDF file, which only a robot from a URDF file can become.

    Raises:
        ModelError: The model has another simulator, or the file cannot hold a parameter.
    """
    simulator, parameters = found_mechanism(model, found)
    if name is not None and name.lower().endswith(".urdf"):
        return export_urdf(simulator, parameters)
    return export_mjcf(simulator, parameters, time_step=found.time_step, name=name)
