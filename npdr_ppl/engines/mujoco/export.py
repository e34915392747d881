"""Writes identified parameters and effects into the text of an MJCF file, and Python beside it."""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.robot_files import is_urdf, read_robot
from npdr_ppl.engines.mujoco.callbacks.python_file import CallbackFile, callback_file
from npdr_ppl.engines.mujoco.effects_in_file import file_assignments, is_in_file, why_not
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mjcf_edits import Edits, array_of
from npdr_ppl.engines.mujoco.mjcf_files import folder_of_assets, mjcf_text, reloaded
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect

__all__ = ["ExportedMjcf", "export_mjcf", "module_name", "written"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExportedMjcf:
    """An MJCF file with identified parameters and effects.

    Attributes:
        name: Name of the robot's file.
        folder: Its folder.
        before: The text of the robot's file, with the content of included files in their place.
        text: The new text.
        callbacks: Python with the effects that MuJoCo does not have itself; ``None`` if there are
            none.
        refused: Why other effects, and armatures in a URDF file, are in neither, by name.
        needs_folder: Whether the text refers to other files, such as meshes, by relative paths.
    """

    name: str
    folder: Path
    before: str
    text: str
    callbacks: CallbackFile | None
    refused: dict[str, str]
    needs_folder: bool


def export_mjcf(
    simulator: MujocoMechanism,
    parameters: Mapping[str, Tensor],
    *,
    time_step: float | None = None,
    name: str | None = None,
) -> ExportedMjcf:
    """Writes parameters and effects into the text of a simulator's file.

    A changed value is written at the element itself, even if a default class set it before. All
    other text stays as it is. The result is loaded again and compared with the model.

    Args:
        simulator: The simulator, effects attached and in the steps in which it was fitted.
        parameters: Values of its parameters and of those of its effects.
        time_step: Seconds per step of the recording; the simulator's own by default.
        name: Name of the new file, which the Python beside it mentions; the old one by default.

    Raises:
        ModelError: The simulator has no file, or a parameter cannot be written into it.
    """
    if simulator.file is None:
        raise ModelError(f"{simulator.name} was made from a compiled model, so it has no file.")
    given = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    time_step = time_step or simulator.time_step
    step = time_step / simulator.num_substeps(time_step)
    files = read_robot(simulator.file)
    before = mjcf_text(simulator.file, files)
    place = folder_of_assets(simulator.file, files)
    original = _Original(before, step, place, has_six_digits=is_urdf(files))
    found = _divided(simulator, given, original)
    chosen = simulator.carrying(e for e in simulator.effects if e.name not in found.refused)
    if found.refused:
        # What is not written does not decide where the others go.
        found = _divided(chosen, given, original)._replace(refused=found.refused)
    text = _new_text(chosen, given, original, found.in_file)
    callbacks = None
    if found.beside:
        robot = name or simulator.file.name
        callbacks = callback_file(
            chosen,
            found.beside,
            {name: float(value) for name, value in given.items()},
            robot=robot,
            module=module_name(robot),
            substeps=simulator.num_substeps(time_step),
        )
    return ExportedMjcf(
        simulator.file.name,
        simulator.file.parent,
        before,
        text,
        callbacks,
        found.refused,
        place is not None,
    )


def module_name(robot: str) -> str:
    """Returns the name of the Python module beside a robot's file, e.g. ``"arm_effects"``."""
    stem = re.sub(r"\W", "_", Path(robot).stem, flags=re.ASCII)
    return f"{'_' * stem[:1].isdigit()}{stem}_effects"


@dataclass(frozen=True)
class _Original:
    """The text that is changed.

    Attributes:
        text: The text.
        step: Seconds per engine step.
        place: Folder in which the text finds the files that it refers to; any if ``None``.
        has_six_digits: Whether its numbers have no more.
    """

    text: str
    step: float
    place: Path | None
    has_six_digits: bool


class _Division(NamedTuple):
    """Where effects go.

    Attributes:
        in_file: Those that the file holds.
        beside: Those that are Python beside it.
        refused: Why others are in neither, by name.
    """

    in_file: tuple[Effect, ...]
    beside: tuple[Effect, ...]
    refused: dict[str, str]


def _divided(
    simulator: MujocoMechanism, given: Mapping[str, Tensor], original: _Original
) -> _Division:
    """Returns where effects go. Each is tried by itself; see :func:`_new_text`."""
    in_file: list[Effect] = []
    beside: list[Effect] = []
    refused: dict[str, str] = {}
    for effect in simulator.effects:
        place = in_file if is_in_file(simulator, effect) else beside
        reason = None if place is in_file else why_not(effect)
        if reason is None:
            alone = simulator.carrying((effect,))
            own = {n: given[n] for n in effect.parameter_names if n in given}
            try:
                _new_text(alone, own, original, (effect,) if place is in_file else ())
            except ModelError as error:
                reason = str(error).rstrip(".")
        if reason is None:
            place.append(effect)
        else:
            refused[effect.name] = reason
    return _Division(tuple(in_file), tuple(beside), refused)


def _new_text(
    simulator: MujocoMechanism,
    given: Mapping[str, Tensor],
    original: _Original,
    in_file: Sequence[Effect],
) -> str:
    """Returns the text with values in it.

    Args:
        simulator: The simulator with the effects to write, to the file or beside it.
        given: Values of parameters, float64 numbers.
        original: The text without them.
        in_file: The effects that the file holds.

    Raises:
        ModelError: A value cannot be written.
    """
    effects = {name for effect in simulator.effects for name in effect.parameter_names}
    own = {p.name for p in simulator.parameters} | effects
    given = {name: value for name, value in given.items() if name in own}
    assignments = file_assignments(simulator, given, in_file, original.step)
    # The solver's settings of dry friction follow from what simulations set, without effects.
    set_anyway, _ = simulator.assignments(given, torch.zeros((), dtype=torch.float64))
    model = written(simulator.prepared(original.step, set(set_anyway)), assignments)
    text = simulator.text_with_second or original.text
    edits = Edits(MjcfText(text.encode()), simulator.model, model)
    for array in dict.fromkeys(array for array, _ in assignments):
        edits.write(array, sorted({at for name, at in assignments if name == array}))
    edits.keep_damping()
    edits.write_options(original.step)
    text = edits.text.result()
    _check(text, original, model)
    return text


def written(model: Any, assignments: Assignments) -> Any:
    """Returns a copy of a model with numbers written into it."""
    changed = copy.copy(model)
    for (array, place), value in assignments.items():
        option = array.removeprefix("opt.")
        if array != option and np.ndim(getattr(changed.opt, option)) == 0:
            setattr(changed.opt, option, float(value))
        else:
            array_of(changed, array).reshape(-1)[place] = float(value)
    return changed


_COMPARED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia",
    "body_gravcomp", "jnt_pos", "jnt_axis", "jnt_stiffness", "jnt_stiffnesspoly", "jnt_range",
    "qpos0", "qpos_spring", "dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss",
    "geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref", "site_pos",
    "actuator_gainprm", "actuator_biasprm", "actuator_dynprm", "actuator_gear",
    "actuator_forcerange", "actuator_ctrlrange", "jnt_actfrcrange", "tendon_stiffness",
    "tendon_damping", "tendon_frictionloss", "tendon_armature", "tendon_lengthspring",
    "opt.gravity", "opt.wind", "opt.density", "opt.viscosity", "opt.timestep", "opt.integrator",
)  # fmt: skip
"""Arrays of a model that the motion follows from."""


def _check(text: str, original: _Original, wanted: Any) -> None:
    """Raises a ModelError if a file does not have the numbers that it should have.

    Args:
        text: The file's text.
        original: The text that was changed.
        wanted: The model that it should describe.
    """
    relative, absolute = (1e-5, 1e-6) if original.has_six_digits else (1e-9, 1e-12)
    found = reloaded(text, ".xml", original.place)
    for name in _COMPARED:
        if not hasattr(wanted, name) and not name.startswith("opt."):
            continue  # of a later version of the engine
        one, other = array_of(found, name).reshape(-1), array_of(wanted, name).reshape(-1)
        if one.shape != other.shape or not np.allclose(one, other, rtol=relative, atol=absolute):
            raise ModelError(
                f"The new file's {name} would differ from the model's, because a setting of the "
                "file replaces it, such as dampratio, inertiafromgeom, springdamper or a <frame>. "
                "Remove that setting, or give other fields as parameters."
            )
