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
    to: Annotated[Path, typer.Option(help="MJCF file to write, beside the robot's own file.")],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a run's parameters and effects into the robot's MJCF file.

    The file keeps its text; changed elements get attributes and a comment with the value that
    they had. Posterior means are written. Effects become what MuJoCo has itself: damping, friction
    loss, springs, payloads, tilted gravity, gains of servos, limits of controls. The others are
    listed and left out.

    Example: npdr export fit arm.xml --to arm_identified.xml
    """
    from npdr_ppl.cli.resolve import resolve_model
    from npdr_ppl.posterior.robot_file import export_robot, identified

    if to.suffix.lower() not in (".xml", ".mjcf"):
        raise DataError(f"{to} is no .xml file; npdr export writes MJCF.")
    if to.exists():
        raise DataError(f"{to} exists already; choose another name or remove it first.")
    values, finer_steps = identified(run)
    found = export_robot(resolve_model(model), values, finer_steps=finer_steps)
    if found.needs_folder and to.absolute().parent != found.folder.absolute():
        raise DataError(
            f"The robot's file refers to others, such as meshes; write the new one to "
            f"{found.folder}."
        )
    with replacing(to) as temporary:
        temporary.write_text(found.text, encoding="utf-8")
    if as_json:
        typer.echo(json.dumps({"file": str(to), "left_out": found.refused}, ensure_ascii=False))
    elif not quiet:
        before, after = found.before.splitlines(), found.text.splitlines()
        for line in difflib.unified_diff(before, after, found.name, to.name, lineterm="", n=0):
            typer.echo(line)
        for name, reason in found.refused.items():
            typer.echo(f"\nnot written: {name}, because {reason}.")
        typer.echo(f"\nThe robot's file with the identified values is {to}")
