"""`npdr export`: writes what a run has identified into the robot's own file."""

import difflib
import json
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.atomic_files import replacing
from npdr_ppl.cli.manners import AsJson, Quiet
from npdr_ppl.cli.options import ModelArgument
from npdr_ppl.errors import DataError

__all__ = ["export"]


def export(
    run: Annotated[Path, typer.Argument(help="Folder that was passed as --out.")],
    model: ModelArgument,
    to: Annotated[
        Path, typer.Option(help="New file; in the robot's folder if the robot has meshes.")
    ],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a copy of the robot's MJCF file with a run's parameters and effects.

    The copy has the same text. Changed elements have the posterior means, and a comment with the
    values that they had. Effects become what MuJoCo has itself: damping, friction loss, springs,
    payloads, tilted gravity, gains and limits of servos and controls. The others become a Python
    file beside it that needs only mujoco and numpy. What can be neither is listed.

    Example: npdr export fit arm.xml --to arm_identified.xml
    """
    from npdr_ppl.cli.resolve import resolve_model
    from npdr_ppl.engines.mujoco.export import module_name
    from npdr_ppl.posterior.robot_file import export_robot, identified

    if to.suffix.lower() not in (".xml", ".mjcf"):
        raise DataError(f"{to} is no .xml file; npdr export writes MJCF.")
    beside = to.with_name(f"{module_name(to.name)}.py")
    run_result = identified(run)
    found = export_robot(resolve_model(model), run_result, to.name)
    for file in (to, beside) if found.callbacks else (to,):
        if file.exists():
            raise DataError(f"{file} exists already; choose another name or remove it first.")
    if found.needs_folder and to.resolve().parent != found.folder.resolve():
        raise DataError(
            f"The robot's file refers to others, such as meshes; write the new one to "
            f"{found.folder}."
        )
    if found.callbacks is not None:
        with replacing(beside) as temporary:
            temporary.write_text(found.callbacks.text, encoding="utf-8")
    with replacing(to) as temporary:
        temporary.write_text(found.text, encoding="utf-8")
    if as_json:
        told = {
            "file": str(to),
            "callbacks": str(beside) if found.callbacks else None,
            "in_callbacks": list(found.callbacks.effects) if found.callbacks else [],
            "left_out": found.refused,
            "verdict": run_result.verdict or None,
        }
        typer.echo(json.dumps(told, ensure_ascii=False))
    elif not quiet:
        before, after = found.before.splitlines(), found.text.splitlines()
        for line in difflib.unified_diff(before, after, found.name, to.name, lineterm="", n=0):
            typer.echo(line)
        for name, reason in found.refused.items():
            typer.echo(f"\nnot written: {name}, because {reason}.")
        if run_result.verdict in ("ambiguous", "unknown"):
            typer.echo(f"\nThe verdict of {run} is {run_result.verdict}: {run_result.reason}")
        typer.echo(f"\nThe robot's file with the identified values is {to}")
        if found.callbacks is not None:
            names = ", ".join(found.callbacks.effects)
            typer.echo(f"MuJoCo does not have {names}; {beside} adds them, and says how.")
