"""Writes identified parameters and effects into the text of an MJCF file."""

import copy
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.robot_files import RobotFiles, is_urdf, read_robot, references
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.effects_in_file import file_assignments, why_not
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mjcf_edits import Edits, array_of
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText, flattened
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.engines.mujoco.urdf_files import as_mjcf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect

__all__ = ["ExportedMjcf", "export_mjcf"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExportedMjcf:
    """An MJCF file with identified parameters and effects.

    Attributes:
        name: Name of the robot's file.
        folder: Its folder.
        before: The text of the robot's file, with the content of included files in their place.
        text: The new text.
        refused: Why effects are not in it, by the effect's name.
        needs_folder: Whether the text refers to other files, such as meshes, by relative paths.
    """

    name: str
    folder: Path
    before: str
    text: str
    refused: dict[str, str]
    needs_folder: bool


def export_mjcf(
    simulator: MujocoMechanism,
    parameters: Mapping[str, Tensor],
    *,
    time_step: float | None = None,
) -> ExportedMjcf:
    """Writes parameters and effects into the text of a simulator's file.

    A changed value is written at the element itself, even if a default class set it before. All
    other text stays as it is. The result is loaded again and compared with the model.

    Args:
        simulator: The simulator, effects attached and in the steps in which it was fitted.
        parameters: Values of its parameters and of those of its effects.
        time_step: Seconds per step of the recording; the simulator's own by default.

    Raises:
        ModelError: The simulator has no file, or a parameter cannot be written into it.
    """
    if simulator.file is None:
        raise ModelError(f"{simulator.name} was made from a compiled model, so it has no file.")
    given = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    time_step = time_step or simulator.time_step
    step = time_step / simulator.num_substeps(time_step)
    files = read_robot(simulator.file)
    before = _text_of(simulator.file, files)
    # Of a URDF file, meshes that were not found are left out.
    trees = [ElementTree.fromstring(before)] if is_urdf(files) else files.trees.values()
    needs_folder = any(True for tree in trees for _ in references(tree))
    place = simulator.file.parent if needs_folder else None
    original = _Original(before, step, place, has_six_digits=is_urdf(files))
    kept, refused = _effects_that_fit(simulator, given, original)
    chosen = copy.copy(simulator)
    chosen.effects = kept
    text = _new_text(chosen, given, original)
    return ExportedMjcf(
        simulator.file.name, simulator.file.parent, before, text, refused, needs_folder
    )


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


def _effects_that_fit(
    simulator: MujocoMechanism, given: Mapping[str, Tensor], original: _Original
) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """Returns the effects that the file can hold, and why it cannot hold the others.

    Each is tried by itself; see :func:`_new_text` for the arguments.
    """
    kept: list[Effect] = []
    refused: dict[str, str] = {}
    alone = copy.copy(simulator)
    for effect in simulator.effects:
        reason = why_not(simulator, effect)
        if reason is None:
            alone.effects = (effect,)
            own = {n: given[n] for n in effect.parameter_names if n in given}
            try:
                _new_text(alone, own, original)
            except ModelError as error:
                reason = str(error).rstrip(".")
        if reason is None:
            kept.append(effect)
        else:
            refused[effect.name] = reason
    return tuple(kept), refused


def _new_text(simulator: MujocoMechanism, given: Mapping[str, Tensor], original: _Original) -> str:
    """Returns the text with values in it.

    Args:
        simulator: The simulator with the effects to write.
        given: Values of parameters, float64 numbers.
        original: The text without them.

    Raises:
        ModelError: A value cannot be written.
    """
    effects = {name for effect in simulator.effects for name in effect.parameter_names}
    own = {p.name for p in simulator.parameters} | effects
    given = {name: value for name, value in given.items() if name in own}
    assignments = file_assignments(simulator, given)
    # The solver's settings of dry friction follow from what simulations set, without effects.
    set_anyway, _ = simulator.assignments(given, torch.zeros((), dtype=torch.float64))
    model = _written(simulator.prepared(original.step, set(set_anyway)), assignments)
    edits = Edits(MjcfText(original.text.encode()), simulator.model, model)
    for array in dict.fromkeys(array for array, _ in assignments):
        edits.write(array, sorted({at for name, at in assignments if name == array}))
    edits.keep_damping()
    edits.write_options(original.step)
    text = edits.text.result()
    _check(text, original, model)
    return text


def _text_of(file: Path, files: RobotFiles) -> str:
    """Returns the MJCF text of a robot's file; of a URDF file, what MuJoCo makes of it."""
    return as_mjcf(file) if is_urdf(files) else flattened(files).decode()


def _written(model: Any, assignments: Assignments) -> Any:
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
    with tempfile.TemporaryDirectory() as folder:
        path = (original.place or Path(folder)) / f".npdr-{uuid4().hex}.xml"
        try:
            path.write_text(text, encoding="utf-8")
            found = load_mjcf(path)
        except ModelError as error:
            raise ModelError(str(error).replace(str(path), "The new text")) from None
        finally:
            path.unlink(missing_ok=True)
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
