"""`npdr export`: takes what a run has identified to other simulators."""

import difflib
import json
import keyword
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from npdr_ppl.atomic_files import replacing
from npdr_ppl.cli.manners import AsJson, Quiet
from npdr_ppl.cli.options import EffectOption, OptionalModelArgument
from npdr_ppl.errors import DataError, ModelError

if TYPE_CHECKING:
    from npdr_ppl.posterior.robot_file import Identified

__all__ = ["export"]


class Kind(StrEnum):
    """What is written."""

    ROBOT = "robot"
    RANGES = "ranges"
    GYMNASIUM = "gymnasium"
    ISAAC_LAB = "isaac-lab"


ENDINGS: Mapping[str, tuple[Kind, ...]] = {
    ".xml": (Kind.ROBOT,),
    ".mjcf": (Kind.ROBOT,),
    ".urdf": (Kind.ROBOT,),
    ".yaml": (Kind.RANGES,),
    ".yml": (Kind.RANGES,),
    ".json": (Kind.RANGES,),
    ".py": (Kind.GYMNASIUM, Kind.ISAAC_LAB),
}
"""What a file with each ending can be."""


def export(
    run: Annotated[Path, typer.Argument(help="Folder that was passed as --out.")],
    model: OptionalModelArgument = None,
    to: Annotated[
        Path | None,
        typer.Option(
            help="New file: .xml or .urdf for a robot, .yaml or .json for ranges, .py for --as. A "
            "robot with meshes stays in its folder."
        ),
    ] = None,
    kind: Annotated[
        Kind | None, typer.Option("--as", help="What to write; by default from the ending.")
    ] = None,
    effect: EffectOption = None,
    draws: Annotated[int, typer.Option(min=1, help="Most draws of the posterior to write.")] = 500,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Take a run's parameters and effects to a robot's file or another simulator.

    A robot's file is a copy with the same text. Changed elements have the posterior means, and a
    comment with the values that they had. Effects become what MuJoCo has itself; the others become
    a Python file beside it that needs only mujoco and numpy. What can be neither is listed.

    The other kinds have draws of the posterior or ranges: a table, a Gymnasium wrapper that takes
    another draw at every reset, or a configuration of Isaac Lab's events. MODEL may be left out
    for a table, and for a discovery: then revised_model.py in its folder is run.

    An effect of your own file, or a learned law, is given as in npdr fit:
    --effect learned_effect.py:LearnedElbow@elbow. Its law is written as numpy.

    Example: npdr export fit arm.xml --to arm_identified.xml
    """
    from npdr_ppl.posterior.robot_file import identified

    if to is None:
        raise DataError("Give the new file, as in --to arm_identified.xml or --to ranges.yaml.")
    kind = _kind(to, kind)
    found = identified(run)
    if kind is Kind.ROBOT:
        own = _model(run, model, effect)
        told = _robot(found, own, to, shows=not (as_json or quiet))
    elif kind is Kind.RANGES:
        told = _ranges(run, to, draws)
    else:
        told = _draws(run, found, lambda: _model(run, model, effect), to, kind, draws)
    told |= {"verdict": found.verdict or None}
    if as_json:
        typer.echo(json.dumps(told, ensure_ascii=False))
    elif not quiet:
        _tell(told, run, found)


def _kind(to: Path, kind: Kind | None) -> Kind:
    """Returns what to write."""
    possible = ENDINGS.get(to.suffix.lower())
    if possible is None:
        raise DataError(
            f"{to} has none of the endings {', '.join(ENDINGS)}, which say what to write."
        )
    if kind is None and len(possible) > 1:
        raise DataError(f"Add --as {' or --as '.join(possible)} to say what {to} is to be.")
    if kind is not None and kind not in possible:
        fitting = [ending for ending, kinds in ENDINGS.items() if kind in kinds]
        raise DataError(f"{to} cannot be {kind}; its ending has to be {' or '.join(fitting)}.")
    return next(iter(possible)) if kind is None else kind


def _model(run: Path, word: str | None, effects: Sequence[str] | None) -> Any:
    """Returns the model of a run; that of a discovery by default is its revised model."""
    from npdr_ppl.cli.resolve import resolve_effects, resolve_model

    revised = run / "revised_model.py"
    if word is None and not revised.is_file():
        raise ModelError(f"Give the model of the run, as in npdr export {run} arm.xml --to …")
    return resolve_effects(resolve_model(word or f"{revised}:revised_model"), effects or [])


def _robot(found: "Identified", model: Any, to: Path, *, shows: bool) -> dict[str, Any]:
    """Writes a robot's file; returns what to tell."""
    from npdr_ppl.engines.mujoco.export import module_name
    from npdr_ppl.posterior.robot_file import export_robot

    beside = to.with_name(f"{module_name(to.name)}.py")
    robot = export_robot(model, found, to.name)
    if robot.needs_folder and to.resolve().parent != robot.folder.resolve():
        raise DataError(
            f"The robot's file refers to others, such as meshes; write the new one to "
            f"{robot.folder}."
        )
    callbacks = robot.callbacks
    texts = {to: robot.text} | ({beside: callbacks.text} if callbacks else {})
    _write({file: text.encode() for file, text in texts.items()})
    if shows:
        before, after = robot.before.splitlines(), robot.text.splitlines()
        for line in difflib.unified_diff(before, after, robot.name, to.name, lineterm="", n=0):
            typer.echo(line)
    return {
        "file": str(to),
        "callbacks": str(beside) if callbacks else None,
        "in_callbacks": list(callbacks.effects) if callbacks else [],
        "left_out": robot.refused,
    }


def _ranges(run: Path, to: Path, num: int) -> dict[str, Any]:
    """Writes a table of ranges; returns what to tell."""
    from npdr_ppl.posterior.range_file import range_file
    from npdr_ppl.posterior.run_draws import run_draws

    drawn = run_draws(run, num)
    _write({to: range_file(drawn, as_json=to.suffix.lower() == ".json").encode()})
    return {"file": str(to), "draws": len(drawn.values), "left_out": {}}


def _draws(
    run: Path, found: "Identified", model: Callable[[], Any], to: Path, kind: Kind, num: int
) -> dict[str, Any]:
    """Writes a Python file for another simulator; returns what to tell."""
    from npdr_ppl.posterior.randomisation import for_gymnasium, for_isaac_lab
    from npdr_ppl.posterior.run_draws import run_draws

    if not to.stem.isidentifier() or keyword.iskeyword(to.stem):
        raise DataError(f"{to.name} cannot be imported; choose a name such as my_robot.py.")
    drawn = run_draws(run, num)
    write = for_gymnasium if kind is Kind.GYMNASIUM else for_isaac_lab
    made = write(model(), found, drawn, to.stem)
    files = {to: made.text.encode()}
    if made.draws is not None:
        files[to.with_suffix(".npz")] = made.draws
    _write(files)
    return {
        "file": str(to),
        "draws_file": str(to.with_suffix(".npz")) if made.draws else None,
        "draws": len(drawn.values),
        "left_out": made.refused,
    }


def _write(files: Mapping[Path, bytes]) -> None:
    """Writes new files, all or none if one exists already."""
    for file in files:
        if file.exists():
            raise DataError(f"{file} exists already; choose another name or remove it first.")
    for file, content in reversed(list(files.items())):
        with replacing(file) as temporary:
            temporary.write_bytes(content)


def _tell(told: Mapping[str, Any], run: Path, found: "Identified") -> None:
    """Prints what was written and what was not."""
    for name, reason in told["left_out"].items():
        typer.echo(f"\nnot written: {name}, because {reason}.")
    if found.verdict in ("ambiguous", "unknown"):
        typer.echo(f"\nThe verdict of {run} is {found.verdict}: {found.reason}")
    typer.echo(f"\nThe identified values are in {told['file']}")
    if told.get("draws_file"):
        typer.echo(f"Its {told['draws']} draws are in {told['draws_file']}")
    if told.get("callbacks"):
        names = ", ".join(told["in_callbacks"])
        typer.echo(f"MuJoCo does not have {names}; {told['callbacks']} adds them, and says how.")
