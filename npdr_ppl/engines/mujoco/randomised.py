"""Draws of parameters as numbers of a MuJoCo model, and a Gymnasium wrapper that sets them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.mujoco.callbacks.python_file import (
    effects_class,
    has_dry_friction,
    python_source,
)
from npdr_ppl.engines.mujoco.effects_in_file import file_assignments, is_in_file, why_not
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ComplianceEffect, Effect
from npdr_ppl.python_text import plain, quoted

__all__ = ["Field", "RandomisedFields", "gymnasium_file", "randomised_fields"]

Array = NDArray[np.float64]

Field = tuple[str, str, str | int, int]
"""A number of a model by names; see :mod:`npdr_ppl.engines.mujoco.callbacks.randomised_env`, which
needs gymnasium."""


@dataclass(frozen=True)
class RandomisedFields:
    """The numbers of a model that draws of parameters set.

    Attributes:
        fields: The numbers.
        values: Their values, ``(draws, fields)``.
        nominal: Their values in the robot's file, ``(fields,)``.
        in_file: Effects among them.
        beside: Effects that the engine does not have, for which there is Python.
        refused: Why other effects are in neither, by name.
    """

    fields: tuple[Field, ...]
    values: Array
    nominal: Array
    in_file: tuple[Effect, ...]
    beside: tuple[Effect, ...]
    refused: dict[str, str]


def randomised_fields(
    simulator: MujocoMechanism, parameters: Mapping[str, Tensor]
) -> RandomisedFields:
    """Returns the numbers of a model that draws of parameters set.

    Args:
        simulator: The simulator, effects attached.
        parameters: Draws of its parameters and of those of its effects, ``(n,)`` each.

    Raises:
        ModelError: A number belongs to something that has no single name.
    """
    refused = {
        e.name: "it adds a joint, which the environment's robot does not have"
        for e in simulator.effects
        if isinstance(e, ComplianceEffect)
    }
    simulator = simulator.carrying(e for e in simulator.effects if e.name not in refused)
    in_file = tuple(e for e in simulator.effects if is_in_file(simulator, e))
    others = [e for e in simulator.effects if e not in in_file]
    refused |= {e.name: reason for e in others if (reason := why_not(e)) is not None}
    given = {n: torch.as_tensor(v).double() for n, v in parameters.items()}
    num = max((value.numel() for value in given.values()), default=1)
    drawn = file_assignments(simulator, given, in_file)
    fields, columns, nominal = [], [], []
    for (array, place), value in drawn.items():
        option = array.removeprefix("opt.")
        owner = simulator.model if array == option else simulator.model.opt
        old = float(np.atleast_1d(getattr(owner, option)).reshape(-1)[place])
        column = value.expand(num).numpy()
        if np.all(column == old):
            continue  # of an effect whose bound Python sets
        fields.append(_field(simulator.model, array, place))
        columns.append(column)
        nominal.append(old)
    return RandomisedFields(
        tuple(fields),
        np.stack(columns, axis=-1) if columns else np.zeros((num, 0)),
        np.array(nominal),
        in_file,
        tuple(e for e in others if e.name not in refused),
        refused,
    )


_KINDS = {
    "body": "body", "jnt": "joint", "dof": "joint", "qpos": "joint", "geom": "geom",
    "site": "site", "actuator": "actuator", "tendon": "tendon", "pair": "pair",
}  # fmt: skip
"""The kind of element to which an array of a model belongs, by the beginning of its name."""


def _field(model: Any, array: str, place: int) -> Field:
    """Returns the address of a number by the name of its element."""
    if array.startswith("opt."):
        return array.removeprefix("opt."), "option", "", place
    values = np.asarray(getattr(model, array))
    kind = _KINDS.get(array.split("_")[0].rstrip("0"), "")
    row, column = divmod(place, int(values[0].size))
    first = {"dof": model.jnt_dofadr, "qpos": model.jnt_qposadr}.get(array[:4].rstrip("_"))
    if first is not None:
        places = np.flatnonzero(np.asarray(first) == row)
        if len(places) != 1:
            raise ModelError(f"{array}[{row}] belongs to a joint of several coordinates.")
        row = int(places[0])
    if not kind:
        raise ModelError(f"{array} cannot be set by the name of an element.")
    return array, kind, getattr(model, kind)(row).name or row, column


def gymnasium_file(
    simulator: MujocoMechanism, found: RandomisedFields, *, module: str, robot: str, substeps: int
) -> str:
    """Returns a Python file with a ``gymnasium.Wrapper``.

    Args:
        simulator: The simulator.
        found: The numbers that draws set.
        module: Name of the file without its ending. The draws are in an ``.npz`` file beside it.
        robot: Name of the robot's file.
        substeps: Engine steps per control step of the recording.
    """
    effects = found.beside
    code, imports = python_source("RandomisedEnv", effects)
    hard = _hard_joints(simulator, found)
    lines = [
        _HEAD.format(robot=plain(robot), module=module, note=_MEASURED if effects else ""),
        *imports,
        "",
        "import gymnasium",
    ]
    lines += ["import mujoco", "import numpy as np", "", "", code]
    lines += ["FIELDS: list[Field] = ["]
    for array, kind, name, place in found.fields:
        lines.append(f'    ("{array}", "{kind}", {quoted(name)}, {place}),')
    lines += ["]", '"""The numbers of the model that the draws set."""', ""]
    lines += [f"HARD_FRICTION: list[str | int] = [{', '.join(map(quoted, hard))}]"]
    lines += ['"""Joints whose dry friction is as hard as the engine allows."""', "", ""]
    if effects:
        lines += [effects_class(simulator, effects, substeps=substeps), ""]
    maker = ", Effects" if effects else ""
    lines += [_TAIL.format(module=module, maker=maker)]
    return "\n".join(lines)


def _hard_joints(simulator: MujocoMechanism, found: RandomisedFields) -> Sequence[str | int]:
    """Returns the joints without dry friction in the file, on which dry friction acts."""
    model: Any = simulator.model
    ports = {port.port.name: port for port in simulator.force_ports}
    widths = {"dof_frictionloss": 1, "dof_solimp": int(model.dof_solimp.shape[1])}
    set_by_parameters = {place // widths[array] for array, place in simulator.bindings.places
                         if array in widths}  # fmt: skip
    result = []
    for effect in (*found.in_file, *found.beside):
        port = ports.get(effect.port)
        if port is None or not has_dry_friction(effect) or port.velocity in set_by_parameters:
            continue
        if model.dof_frictionloss[port.velocity] == 0.0:
            result.append(model.joint(port.joint).name or port.joint)
    return list(dict.fromkeys(result))


_HEAD = '''"""Another {robot} at every reset, by draws of what npdr_ppl identified.

Needs gymnasium and mujoco. The draws are in {module}.npz; they keep the correlations of the
parameters. The environment has to load the same robot. Its own time step and integrator stay.

    import gymnasium
    from {module} import RandomisedRobot

    env = RandomisedRobot(gymnasium.make("...", xml_file="{robot}"))
    observation, info = env.reset(seed=0)  # info["parameters"] are those of the draw
{note}"""
'''

_MEASURED = """
Observations are the environment's own. What the robot's sensors report, with the errors that were
identified, is in info["measured"].
"""

_TAIL = '''class RandomisedRobot(RandomisedEnv):
    """The environment with another draw of the identified robot at every reset.

    Args:
        env: A MuJoCo environment of the robot.
        draws: File of the draws; the one beside this file by default.
    """

    def __init__(self, env: Any, draws: str | Path | None = None) -> None:
        file = Path(__file__).with_name("{module}.npz") if draws is None else draws
        super().__init__(env, FIELDS, file, HARD_FRICTION{maker})
'''
