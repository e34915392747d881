"""Draws of parameters as ranges of Isaac Lab's events.

The terms are those of ``isaaclab.envs.mdp``: ``randomize_rigid_body_mass``,
``randomize_rigid_body_com``, ``randomize_rigid_body_material``, ``randomize_joint_parameters``,
``randomize_actuator_gains`` and ``randomize_physics_scene_gravity``. They draw each number by
itself, uniformly, so correlations are lost. Names and arguments are those of Isaac Lab 2.3.2 and
3.0.0; ``benchmarks/isaac_lab.py`` compares them with another version.
"""

import re
import textwrap
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.fields import (
    actuated_joint,
    element_names,
    follows_its_command,
    servo_gains,
)
from npdr_ppl.engines.mujoco.randomised import Field, RandomisedFields
from npdr_ppl.python_text import plain, quoted

__all__ = ["isaac_lab_file"]

Array = NDArray[np.float64]

PROBABILITY = 0.94
"""Share of the draws that a range holds: that of the intervals of fits and discoveries."""

_JOINT = {
    ("dof_frictionloss", 0): "friction_distribution_params",
    ("dof_armature", 0): "armature_distribution_params",
    ("jnt_range", 0): "lower_limit_distribution_params",
    ("jnt_range", 1): "upper_limit_distribution_params",
}
"""Arguments of ``randomize_joint_parameters``, by array and place."""

_GAINS = {"actuator_gainprm", "actuator_biasprm", "dof_damping", "actuator_gear"}


@dataclass
class _Term:
    """A term of a configuration.

    Attributes:
        function: Name in ``isaaclab.envs.mdp``.
        mode: When it acts.
        asset: What follows ``SceneEntityCfg("robot"``; ``None`` if it has no asset.
        arguments: Other parameters as Python.
        note: What a reader has to know.
    """

    function: str
    mode: str
    asset: str | None
    arguments: dict[str, str] = field(default_factory=dict)
    note: str = ""


def isaac_lab_file(
    model: Any, found: RandomisedFields, *, module: str, robot: str
) -> tuple[str, dict[str, str]]:
    """Returns a Python file with a configuration of events, and what is not in it, with reasons.

    Args:
        model: The ``mujoco.MjModel``.
        found: The numbers that draws set.
        module: Name of the file without its ending.
        robot: Name of the robot's file.
    """
    terms: dict[str, _Term] = {}
    refused = dict(found.refused)
    refused |= {e.name: "Isaac Lab has no event for this law" for e in found.beside}
    columns = dict(zip(found.fields, found.values.T, strict=True))
    nominal = dict(zip(found.fields, found.nominal.tolist(), strict=True))
    for place, values in columns.items():
        array, kind, name, component = place
        key = f"{kind}_{name}"
        if not isinstance(name, str):
            refused[f"{array} of {kind} {name}"] = "it has no name in the robot's file"
        elif array == "body_mass":
            is_solid = any(f[0] == "body_inertia" and f[2] == name for f in columns)
            terms[f"{key}_mass"] = _mass(name, values, is_solid)
        elif array == "body_ipos":
            own = terms.setdefault(f"{key}_centre", _centre(name))
            low, high = _ends(values - nominal[place])
            own.arguments.setdefault("com_range", "")
            own.arguments["com_range"] += f'"{"xyz"[component]}": ({low!r}, {high!r}), '
        elif (array, component) in _JOINT:
            own = terms.setdefault(f"{key}_parameters", _joint(name))
            own.arguments[_JOINT[array, component]] = repr(_ends(values))
        elif (array, component) == ("geom_friction", 0):
            number = int(model.geom(name).bodyid[0])
            body = model.body(number).name
            if number == 0:
                refused[f"{array} of {name}"] = "it belongs to the world, not to the robot"
            elif not body:
                refused[f"{array} of {name}"] = "its body has no name in the robot's file"
            else:
                terms[f"body_{body}_material"] = _material(model, body, columns)
        elif array == "gravity":
            terms["gravity"] = _gravity(model, columns)
        elif array == "body_iquat":
            refused[f"inertia of {name}"] = (
                "Isaac Lab scales it with the mass, but a load away from the centre also turns it"
            )
        elif array == "body_inertia" and ("body_mass", kind, name, 0) in columns:
            continue  # it follows the mass
        elif array not in _GAINS:
            refused[f"{array} of {name}" if name else array] = "Isaac Lab has no event for it"
    for joint, gains in _joint_gains(model, columns, len(found.values)).items():
        terms[f"joint_{joint}_gains"] = gains
    refused |= _undriven(model, columns)
    return _text(terms, refused, module=module, robot=robot), refused


def _exactly(name: str) -> str:
    """Returns a name as Python; Isaac Lab takes names as regular expressions."""
    return quoted(name if re.fullmatch(r"[\w-]+", name) else re.escape(name))


def _ends(values: Array) -> tuple[float, float]:
    """Returns the ends of the central range of some draws."""
    low, high = np.quantile(values, [0.5 - PROBABILITY / 2.0, 0.5 + PROBABILITY / 2.0])
    return float(f"{low:.6g}"), float(f"{high:.6g}")


def _mass(body: str, values: Array, is_solid: bool) -> _Term:
    arguments = {
        "mass_distribution_params": repr(_ends(values)),
        "operation": '"abs"',
        "recompute_inertia": repr(is_solid),
    }
    return _Term("randomize_rigid_body_mass", "startup", f"body_names={_exactly(body)}", arguments)


def _centre(body: str) -> _Term:
    note = "Offsets from the centre in the robot's file, in m."
    return _Term("randomize_rigid_body_com", "startup", f"body_names={_exactly(body)}", {}, note)


def _joint(joint: str) -> _Term:
    note = (
        "PhysX 5.6 takes friction as an effort in N m or N, earlier ones as a coefficient. "
        "With PhysX, static, dynamic and viscous friction are drawn from this range; Newton has "
        "static friction only."
    )
    return _Term(
        "randomize_joint_parameters",
        "startup",
        f"joint_names={_exactly(joint)}",
        {"operation": '"abs"', "distribution": '"uniform"'},
        note,
    )


def _material(model: Any, body: str, columns: Mapping[Field, Array]) -> _Term:
    own = [
        values
        for (array, _, name, component), values in columns.items()
        if (array, component) == ("geom_friction", 0)
        and model.body(int(model.geom(name).bodyid[0])).name == body
    ]
    ends = repr(_ends(np.concatenate(own)))
    arguments = {
        "static_friction_range": ends,
        "dynamic_friction_range": ends,
        "restitution_range": "(0.0, 0.0)",
        "num_buckets": "64",
        "make_consistent": "True",
    }
    note = "All shapes of the body get it. MuJoCo takes the greater friction of two geoms."
    asset = f"body_names={_exactly(body)}"
    return _Term("randomize_rigid_body_material", "startup", asset, arguments, note)


def _gravity(model: Any, columns: Mapping[Field, Array]) -> _Term:
    ends = [
        _ends(columns[place]) if place in columns else (float(g), float(g))
        for place, g in ((("gravity", "option", "", i), model.opt.gravity[i]) for i in range(3))
    ]
    low, high = ([end[i] for end in ends] for i in range(2))
    return _Term(
        "randomize_physics_scene_gravity",
        "reset",
        None,
        {"gravity_distribution_params": f"({low!r}, {high!r})", "operation": '"abs"'},
        "With PhysX one gravity for all environments, with Newton one for each.",
    )


def _joint_gains(model: Any, columns: Mapping[Field, Array], num: int) -> dict[str | int, _Term]:
    """Returns terms for the gains of joints: stiffness kp, and damping kv plus the joint's own."""
    names = element_names(model, "joint")
    result: dict[str | int, _Term] = {}
    stiffness: dict[int, Any] = {}
    damping: dict[int, Any] = defaultdict(float)
    changed: set[int] = set()

    def drawn(array: str, kind: str, row: int, component: int, old: float) -> Any:
        name = getattr(model, kind)(row).name or row
        return columns.get((array, kind, name, component), np.full(num, float(old)))

    for joint in range(model.njnt):
        dof = int(model.jnt_dofadr[joint])
        name = model.joint(joint).name or joint
        damping[joint] = drawn("dof_damping", "joint", joint, 0, model.dof_damping[dof])
        if ("dof_damping", "joint", name, 0) in columns:
            changed.add(joint)
    for actuator in range(model.nu):
        joint = actuated_joint(model, actuator)
        gains = servo_gains(model, actuator)
        if joint is None or not follows_its_command(model, actuator):
            continue
        name = model.actuator(actuator).name or actuator
        gear = drawn("actuator_gear", "actuator", actuator, 0, model.actuator_gear[actuator, 0])
        if "kp" in gains:
            own = model.actuator_gainprm[actuator, 0]
            kp = drawn("actuator_gainprm", "actuator", actuator, 0, own)
            stiffness[joint] = stiffness.get(joint, 0.0) + gear**2 * kp
        bias = drawn(
            "actuator_biasprm", "actuator", actuator, 2, model.actuator_biasprm[actuator, 2]
        )
        damping[joint] = damping[joint] - gear**2 * bias
        if any(place[0] in _GAINS and place[1:3] == ("actuator", name) for place in columns):
            changed.add(joint)
    for joint in sorted(changed):
        if not model.joint(joint).name:
            continue  # it is among what has no name
        arguments = {}
        if joint in stiffness:
            arguments["stiffness_distribution_params"] = repr(_ends(stiffness[joint]))
        arguments["damping_distribution_params"] = repr(_ends(damping[joint]))
        arguments |= {"operation": '"abs"', "distribution": '"uniform"'}
        note = "Damping is that of the joint and of its servo."
        asset = f"joint_names={_exactly(model.joint(joint).name)}"
        result[names[joint]] = _Term("randomize_actuator_gains", "reset", asset, arguments, note)
    return result


def _undriven(model: Any, columns: Mapping[Field, Array]) -> dict[str, str]:
    """Returns the gains of actuators that are no servos, which Isaac Lab does not randomise."""
    result = {}
    for array, kind, name, _ in columns:
        if kind != "actuator" or array not in _GAINS:
            continue
        number = model.actuator(name).id
        if not follows_its_command(model, number) or actuated_joint(model, number) is None:
            result[f"{array} of {name}"] = "Isaac Lab randomises the gains of servos only"
    return result


def _text(
    terms: Mapping[str, _Term], refused: Mapping[str, str], *, module: str, robot: str
) -> str:
    lines = [_HEAD.format(module=module, robot=plain(robot))]
    taken: set[str] = set()
    for name, term in terms.items():
        lines += textwrap.wrap(term.note, 90, initial_indent="    # ", subsequent_indent="    # ")
        safe = re.sub(r"\W", "_", name, flags=re.ASCII)
        while safe in taken:  # left-leg and left_leg
            safe += "_"
        taken.add(safe)
        lines += [f"    {safe} = EventTerm(", f"        func=mdp.{term.function},"]
        lines += [f'        mode="{term.mode}",', "        params={"]
        if term.asset is not None:
            lines.append(f'            "asset_cfg": SceneEntityCfg("robot", {term.asset}),')
        for key, text in term.arguments.items():
            text = f"{{{text.rstrip(', ')}}}" if key == "com_range" else text
            lines.append(f'            "{key}": {text},')
        lines += ["        },", "    )"]
    if not terms:
        lines.append("    pass")
    if refused:
        lines += ["", "    # Left out:"]
        lines += [
            f"    # {plain(f'{name}, because {reason}')}" for name, reason in refused.items()
        ]
    return "\n".join(lines) + "\n"


_HEAD = '''"""Events of Isaac Lab with the ranges that npdr_ppl identified for {robot}.

The ranges hold 94 % of the posterior draws of each number. Isaac Lab draws each number by itself,
so the correlations of the parameters are lost; widen or narrow the ranges accordingly. Names of
bodies and joints are those of the robot's file.

    from {module} import EventCfg

    class MyEnvCfg(ManagerBasedRLEnvCfg):
        events = EventCfg()
"""

from isaaclab.envs import mdp
from isaaclab.managers import EventTermCfg as EventTerm
from isaaclab.managers import SceneEntityCfg
from isaaclab.utils import configclass


@configclass
class EventCfg:
    """Randomisation of the identified numbers."""
'''
