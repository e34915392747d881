"""What `npdr inspect` says about a robot's file: parameters, columns of a log, and ports."""

import importlib
import json
import math
import os
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from npdr_ppl.atomic_files import replacing
from npdr_ppl.cli.printing import WIDTH
from npdr_ppl.progress import words_for
from npdr_ppl.python_files import check_exists

if TYPE_CHECKING:
    from npdr_ppl.engines.mujoco import MujocoSimulator
    from npdr_ppl.engines.mujoco.derived_model import DerivedModel
    from npdr_ppl.language.channels import Channel

__all__ = ["column_lines", "in_columns", "inspect_robot", "port_lines"]

_NO_BREAK = "\N{NO-BREAK SPACE}"

RECORDED = 10.0
"""Length in s of the recording for which times are printed."""


def inspect_robot(path: Path, write: Path | None, as_json: bool) -> None:
    """Prints the model that is derived from a robot's file, and the columns that a log needs.

    Args:
        path: The MJCF or URDF file.
        write: Python file to write the model to; ``None`` for none. It must not exist.
        as_json: Whether to print JSON.

    Raises:
        ModelError: The file is bad, or no model can be derived from it.
    """
    from npdr_ppl.engines.mujoco import MujocoSimulator
    from npdr_ppl.engines.mujoco.derived_model import derive_model

    check_exists(path, "*.*")
    derived = derive_model(path)
    robot = MujocoSimulator(path)
    found = _described(derived, robot) | {"expected time": _expected_time(path, robot)}
    if as_json:
        typer.echo(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        for line in _lines(found):
            typer.echo("".join(c if c.isprintable() else "?" for c in line))
    if write is not None:
        folder = write.absolute().parent
        with replacing(write) as temporary:
            source = derived.source(os.path.relpath(path.absolute(), folder))
            temporary.write_text(source, encoding="utf-8")
    if not as_json:
        model = str(path)
        if write is not None:
            model = f"{write}:model"
            typer.echo(f"\nWrote {write}. Edit its priors, then:")
        else:
            typer.echo("\nUse it as it is, or write it as Python to edit with --write FILE.py:")
        typer.echo(f"    npdr fit {model} --data LOG --out fit")


def _expected_time(path: Path, robot: "MujocoSimulator") -> dict[str, float | None]:
    """Returns how long the first fit of a recording takes in s, for JSON."""
    from npdr_ppl.cli.resolve import resolve_model
    from npdr_ppl.errors import NpdrError
    from npdr_ppl.preparation.expected_time import seconds_to_fit

    sensors = {sensor.name for sensor in robot.sensors}
    pose = {
        state.name: 0.0
        if component.is_velocity
        else float(robot.initial_positions[component.address])
        for component, state in zip(robot.components, robot.states, strict=True)
        if state.rate_of is None and state.name in sensors
    }
    try:
        seconds = seconds_to_fit(resolve_model(str(path)), pose, recorded=RECORDED)
    except NpdrError:  # the fit will say what is wrong
        seconds = None
    return {"recorded": RECORDED, "first fit": seconds}


def _described(derived: "DerivedModel", robot: "MujocoSimulator") -> dict[str, Any]:
    """Returns what is known of a robot, for JSON."""
    from npdr_ppl.rollouts.logs.matching import columns_of
    from npdr_ppl.rollouts.logs.pose_names import FRAMES, pose_parts

    rates = {state.name: state.rate_of for state in robot.states}
    limits = _joint_limits(robot)
    floating = tuple(f"{joint}_" for joint in _free_joints(robot))
    parts = pose_parts([s.name for s in robot.sensors if s.name.startswith(floating)])
    frames = {name: FRAMES[part] for name, (part, _) in parts.items()}
    # Of two joints that follow from each other, the first one follows.
    followers = {c.name for c in columns_of(robot.sensors, (), robot.followers) if c.follows}

    def column(channel: "Channel", role: str) -> dict[str, Any]:
        ends = limits.get(channel.name, [channel.lower, channel.upper])
        return {
            "name": channel.name,
            "unit": channel.unit,
            "role": role,
            "range": ends if all(map(math.isfinite, ends)) else None,
            "frame": frames.get(channel.name),
            "may be left out": channel.name in followers or rates.get(channel.name) is not None,
        }

    return {
        "file": derived.title,
        "time step": robot.time_step,
        "parameters": [
            {
                "name": p.name,
                "sets": p.field,
                "unit": p.unit,
                "nominal": p.nominal,
                "prior": [p.low, p.high],
                "family": p.family,
            }
            for p in derived.parameters
        ],
        "not varied": {field: derived.reason(field) for field in derived.held},
        "columns": [
            *(column(c, "measurement") for c in robot.sensors),
            *(column(c, "command") for c in robot.actions),
        ],
        "ports": [
            {"name": p.name, "kind": p.kind, "unit": p.unit, "is floating": p.is_floating}
            for p in robot.ports
        ],
    }


def _free_joints(robot: "MujocoSimulator") -> list[str]:
    """Returns the names of the joints by which bodies float."""
    from npdr_ppl.engines.mujoco.fields import element_names

    mujoco: Any = importlib.import_module("mujoco")
    names = element_names(robot.model, "joint")
    is_free = robot.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    return [name for name, free in zip(names, is_free, strict=True) if free]


def _joint_limits(robot: "MujocoSimulator") -> dict[str, list[float]]:
    """Returns the limits of joints whose positions are states, by the state's name.

    They show whether the file's angles were read in the unit that was meant.
    """
    model = robot.model
    joints = {p.position: p.joint for p in robot.force_ports if p.position is not None}
    return {
        state.name: model.jnt_range[joints[component.address]].tolist()
        for component, state in zip(robot.components, robot.states, strict=True)
        if not component.is_velocity
        and component.address in joints
        and model.jnt_limited[joints[component.address]]
    }


def _lines(found: dict[str, Any]) -> list[str]:
    """Returns the description as text."""
    from npdr_ppl.preparation.expected_time import FEWEST_FITS, MOST_FITS

    step, parameters = found["time step"], found["parameters"]
    rows = [("parameter", "file", "prior", "unit", "sets")]
    for p in parameters:
        low, high = p["prior"]
        prior = f"{low:.4g} … {high:.4g}" + ("*" if p["family"] == "log-normal" else "")
        rows.append((p["name"], f"{p['nominal']:.4g}", prior, p["unit"], p["sets"]))
    lines = [
        f"{found['file']}: {len(parameters)} parameters, time step {step:g} s ({1 / step:.4g} Hz)",
        "",
        *in_columns(rows),
    ]
    if any(p["family"] == "log-normal" for p in parameters):
        lines += ["  * log-normal; the range has 95 % of it"]
    if found["not varied"]:
        lines += ["", "Not varied, because positions do not determine them:"]
        lines += [f"  {field}: {reason}" for field, reason in found["not varied"].items()]
    hint = "npdr inspect LOG --model FILE --write MAPPING"
    lines += ["", *column_lines(found, hint), "", *port_lines(found)]
    expected = found["expected time"]
    if expected["first fit"] is not None:
        first = words_for(expected["first fit"])
        rows = [
            ("closest fit", first, "the first step of npdr fit and npdr discover"),
            ("npdr discover", f"{FEWEST_FITS} to {MOST_FITS} times as long", ""),
        ]
        title = f"Expected time on this machine, for {expected['recorded']:g} s of recording"
        lines += ["", f"{title}, roughly:", *in_columns(rows)]
    return lines


def column_lines(found: dict[str, Any], hint: str) -> list[str]:
    """Returns the lines about the columns that a log needs.

    Args:
        found: The description of a model, with ``columns``.
        hint: The command that maps other names.
    """
    # Only joints of robots' files have limits that a simulation knows.
    limits = "joint limits" if "file" in found else "range"
    rows = [("column of a log", "unit", "")]
    rows += [("time", "s", "constant steps, also other ones than the model's")]
    for c in found["columns"]:
        span = "" if c["range"] is None else "{:.4g} … {:.4g}".format(*c["range"])
        remark = f"{limits} {span}" if span else ""
        if c["may be left out"]:
            remark = "may be left out"
        if c["role"] == "command":
            remark = f"command, {span}" if span else "command"
        if c.get("frame"):
            remark = f"{remark}; {c['frame']}" if remark else c["frame"]
        rows.append((c["name"], c["unit"], remark))
    lines = in_columns(rows)
    if not any(c["role"] == "command" for c in found["columns"]):
        lines.append("  No actuators: the motion is taken as free.")
    return [*lines, f"  Other names in a log: {hint}, then --mapping."]


def port_lines(found: dict[str, Any]) -> list[str]:
    """Returns the lines about the ports of a model, which ``found`` describes."""
    lines = ["Ports, where effects attach (npdr effects) by --effect PORT.EFFECT:"]

    def title(port: dict[str, Any]) -> str:
        floats = " on a floating body, along and about its own axes"
        return str(port["kind"]) + (floats if port.get("is floating") else "")

    for kind in dict.fromkeys(map(title, found["ports"])):
        same = [port for port in found["ports"] if title(port) == kind]
        names = [f"{p['name']} [{p['unit']}]" if p["unit"] else p["name"] for p in same]
        # A name stays in one line with its unit, which may have spaces in it.
        whole = [name.replace(" ", _NO_BREAK) for name in names]
        told = f"  {kind}: {', '.join(whole)}"
        parts = textwrap.wrap(
            told,
            WIDTH,
            subsequent_indent="    ",
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines += [part.replace(_NO_BREAK, " ") for part in parts]
    if not found["ports"]:
        lines.append("  none are declared")
    return lines


def in_columns(rows: list[tuple[str, ...]]) -> list[str]:
    """Returns rows with columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            ["", *(cell.ljust(width) for cell, width in zip(row, widths, strict=True))]
        ).rstrip()
        for row in rows
    ]
