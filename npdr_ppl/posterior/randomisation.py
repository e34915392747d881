"""Writes a run's draws for simulators of others: a Gymnasium wrapper, events of Isaac Lab."""

import io
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from npdr_ppl.engines.mujoco.isaac_lab import isaac_lab_file
from npdr_ppl.engines.mujoco.randomised import gymnasium_file, randomised_fields
from npdr_ppl.errors import DataError
from npdr_ppl.language.only_simulator import only_simulator
from npdr_ppl.posterior.robot_file import Identified, found_mechanism, revised_model
from npdr_ppl.posterior.run_draws import RunDraws

__all__ = ["ExportedDraws", "for_gymnasium", "for_isaac_lab"]


class ExportedDraws(NamedTuple):
    """A Python file with a run's draws.

    Attributes:
        text: Its text.
        draws: Content of the ``.npz`` file beside it; ``None`` if there is none.
        refused: What is in neither, by name, with reasons.
    """

    text: str
    draws: bytes | None
    refused: dict[str, str]


def for_gymnasium(
    model: Callable[..., Any], found: Identified, draws: RunDraws, module: str
) -> ExportedDraws:
    """Returns a ``gymnasium.Wrapper`` that takes another draw at every reset.

    Args:
        model: A Pyro model with one simulator, a ``MujocoSimulator``.
        found: What the run found.
        draws: Draws of its posterior.
        module: Name of the Python file without its ending.

    Raises:
        ModelError: The model has another simulator, or other parameters than the run.
        DataError: The draws set nothing that the wrapper could change.
    """
    simulator, fields, time_step = _fields(model, found, draws)
    substeps = simulator.num_substeps(time_step)
    robot = simulator.file.name if simulator.file else "robot"
    text = gymnasium_file(simulator, fields, module=module, robot=robot, substeps=substeps)
    if not fields.fields and not fields.beside:
        raise DataError("The run's parameters change nothing of a MuJoCo model.")
    content = io.BytesIO()
    names = np.array(list(draws.means))
    np.savez(content, fields=fields.values, parameters=draws.values, names=names)
    return ExportedDraws(text, content.getvalue(), fields.refused)


def for_isaac_lab(
    model: Callable[..., Any], found: Identified, draws: RunDraws, module: str
) -> ExportedDraws:
    """Returns a configuration of Isaac Lab's events; see :func:`for_gymnasium`."""
    simulator, fields, _ = _fields(model, found, draws)
    robot = simulator.file.name if simulator.file else "robot"
    text, refused = isaac_lab_file(simulator.model, fields, module=module, robot=robot)
    return ExportedDraws(text, None, refused)


def _fields(model: Callable[..., Any], found: Identified, draws: RunDraws) -> Any:
    """Returns the simulator, the numbers that draws set, and the recording's time step."""
    simulator, _ = found_mechanism(model, found)
    given = {
        name: torch.from_numpy(draws.values[:, i].copy()) for i, name in enumerate(draws.means)
    }
    box, _ = only_simulator(revised_model(model, found), given)
    fields = randomised_fields(simulator, box.parameters)
    return simulator, fields, found.time_step or simulator.time_step
