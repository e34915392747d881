"""`npdr inspect` shows what a log contains; `npdr convert` makes rollouts of logs."""

import dataclasses
import json
import math
import shutil
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from npdr_ppl.atomic_files import replacing
from npdr_ppl.cli.inspected_models import inspect_model
from npdr_ppl.cli.manners import AsJson
from npdr_ppl.cli.model_files import is_robot
from npdr_ppl.cli.names import MODELS, complete_model
from npdr_ppl.cli.options import MappingOption, OutOption
from npdr_ppl.cli.resolve import columns_of_model
from npdr_ppl.cli.robots import inspect_robot
from npdr_ppl.errors import DataError

if TYPE_CHECKING:
    from npdr_ppl.rollouts import Rollouts
    from npdr_ppl.rollouts.logs.inspection import Description, SignalSummary, Timing

__all__ = ["convert", "inspect"]

WIDTH = 80
"""Largest width of what is printed, in characters."""

NAME_WIDTH = 42
"""Width of the column of names in characters; a longer name gets a line of its own."""


def inspect(
    log: Annotated[
        Path,
        typer.Argument(
            help="CSV, Parquet, HDF5, MAT, MCAP, a ROS 2 bag, a LeRobot data set, a folder of "
            "CSV files; or a model: a robot's MJCF or URDF file, path/to/file.py:function, or "
            "a model of the zoo.",
            autocompletion=complete_model,
        ),
    ],
    mapping: MappingOption = None,
    write: Annotated[
        Path | None,
        typer.Option(help="Write a mapping (TOML), or a robot's model (Python), to start from."),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Model or robot file whose sensors and actions the written mapping names.",
            autocompletion=complete_model,
        ),
    ] = "",
    time: Annotated[str, typer.Option(help="Name of the column with the time stamps.")] = "",
    time_step: Annotated[
        float | None,
        typer.Option(help="Seconds between the rows of a log without stamps, else between steps."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the signals of a log: rate, largest gap, jitter, range, unit, and what they may be.

    Of a model, such as a robot's MJCF or URDF file, it shows the parameters with their priors, the
    columns that a log needs, and the ports of effects.

    Example: npdr inspect bag_folder --model robot.xml --write mapping.toml
    """
    import msgspec

    from npdr_ppl.rollouts import Rollouts
    from npdr_ppl.rollouts.logs.inspection import described
    from npdr_ppl.rollouts.logs.mapping import Mapping
    from npdr_ppl.rollouts.logs.mapping_template import mapping_to_start_from, without_signal
    from npdr_ppl.rollouts.logs.read import read_log

    if write is not None and write.exists():
        raise DataError(f"{write} exists already; choose another name or remove it first.")
    if is_robot(str(log)):
        if mapping is not None or model or time or time_step is not None:
            raise DataError(
                f"--mapping, --model, --time and --time-step are for logs; {log} is a robot."
            )
        inspect_robot(log, write, as_json)
        return
    if _is_model(log):
        if mapping is not None or model or time or time_step is not None or write is not None:
            raise DataError(
                "--mapping, --write, --model, --time and --time-step are for logs; "
                f"{log} is a model."
            )
        inspect_model(str(log), as_json)
        return
    if model and write is None:
        raise DataError("--model is for the mapping that --write writes; name its file.")
    columns = columns_of_model(model) if model else ()
    chosen = Mapping() if mapping is None else Mapping.of(mapping)
    stated = {"time": time or chosen.log.time, "time_step": time_step or chosen.log.time_step}
    settings = msgspec.structs.replace(chosen.log, **stated)
    chosen = Mapping.of(msgspec.to_builtins(msgspec.structs.replace(chosen, log=settings)))
    content = read_log(log, settings)
    found = described(content)
    if chosen.channels:  # its remarks on units are those that count
        found = dataclasses.replace(found, notes=content.notes)
    if as_json:
        told = _without_nan(dataclasses.asdict(found))
        typer.echo(json.dumps(told, indent=2, ensure_ascii=False))
    else:
        for line in _lines(found):
            typer.echo(line)
    if chosen.channels:
        rollouts = Rollouts.of(chosen.apply(content))
        if not as_json:
            typer.echo(f"\nWith {mapping}:")
            _print_rollouts(rollouts, known=content.notes)
    elif mapping is not None and not as_json:
        typer.echo(f"\n{mapping} has no channels, so no rollouts are made.")
    if write is not None:
        with replacing(write) as temporary:
            text = mapping_to_start_from(found, settings, model=model, columns=columns)
            temporary.write_text(text, encoding="utf-8")
        if not as_json:
            missing = without_signal(found, columns) if model else []
            if missing:
                typer.echo(f"\nWrote {write}.")
                typer.echo(_wrapped(f"No signal was found for {', '.join(missing)}."))
                typer.echo("Add what is missing, check names and units, then:")
            else:
                typer.echo(f"\nWrote {write}. Check its names and units, then:")
            typer.echo(f"    npdr fit {model or 'MODEL'} --data {log} --mapping {write} --out fit")
            if not model:
                _print_lack_of_actions(found)


def _is_model(log: Path) -> bool:
    """Returns whether an argument names a model rather than a log."""
    if log.exists():
        return log.suffix == ".py"
    return str(log) in MODELS or ".py:" in str(log)


def convert(
    logs: Annotated[
        list[Path], typer.Argument(help="Logs; each becomes one or several rollouts.")
    ],
    out: OutOption,
    mapping: MappingOption = None,
) -> None:
    """Make rollouts of logs, and write them to a .parquet, .csv, .npz or .nc file.

    Example: npdr convert monday.mcap tuesday.mcap --mapping mapping.toml --out rollouts.parquet
    """
    from npdr_ppl.cli.resolve import load_all

    writers = {".parquet": "to_parquet", ".csv": "to_csv", ".npz": "to_npz", ".nc": "to_netcdf"}
    writer = writers.get(out.suffix.lower())
    if writer is None:
        raise DataError(f"--out should end in {', '.join(writers)}; got {out}.")
    rollouts: Rollouts = load_all(logs, mapping)
    getattr(rollouts, writer)(out)
    _print_rollouts(rollouts)
    if not rollouts.is_whole and writer in ("to_csv", "to_parquet"):
        typer.echo(
            _wrapped(
                f"{out.suffix} files hold gaps, but no other steps that are left out; "
                ".npz and .nc files do."
            )
        )
    typer.echo(f"Wrote {out}.")


def _print_rollouts(rollouts: "Rollouts", known: Sequence[str] = ()) -> None:
    """Prints rollouts in a line, and how they were read.

    Args:
        rollouts: The rollouts.
        known: Notes that were printed before.
    """
    typer.echo(_wrapped(repr(rollouts)))
    for note in rollouts.notes:
        if note not in known:
            typer.echo(_wrapped(note, "  "))
    if not rollouts.action_names:
        typer.echo("No actions: the motion is taken as free.")


def _print_lack_of_actions(found: "Description") -> None:
    """Prints that a written mapping has no actions, and which signals may be some."""
    from npdr_ppl.rollouts.logs.mapping_template import possible_actions, proposed_actions

    if proposed_actions(found):
        return
    possible = possible_actions(found)
    hint = (
        f" If {_listed(possible)} is a command, remove the # before its lines." if possible else ""
    )
    typer.echo(_wrapped(f"No actions: the motion is taken as free.{hint}"))


def _listed(names: Sequence[str], most: int = 3) -> str:
    """Returns the first names, separated by "or"."""
    return " or ".join([*names[:most], *(["another one"] if len(names) > most else [])])


def _lines(found: "Description") -> Sequence[str]:
    """Returns the description of a log, line by line."""
    count = sum(len(timing.signals) for timing in found.timings)
    lines = [_cut(f"{found.source}: {count} signals, {found.duration:.4g} s")]
    for timing in found.timings:
        lines += ["", *_timing_lines(timing)]
        lines += [line for signal in timing.signals for line in _signal_lines(signal)]
    if found.notes or found.episodes:
        lines.append("")
    if found.episodes:
        lines.append(_wrapped(f"episodes: {found.episodes}", "  "))
    return [*lines, *(_wrapped(note, "  ") for note in found.notes)]


def _timing_lines(timing: "Timing") -> list[str]:
    from npdr_ppl.rollouts.logs.inspection import GAP

    if not math.isfinite(timing.step):
        return [f"{timing.count} samples"]
    lines = [
        f"{timing.count} samples from {timing.begin:.6g} to {timing.end:.6g} s, "
        f"{1 / timing.step:.4g} Hz",
        f"  usual step {_duration(timing.step)}, 95 % of steps within "
        f"± {_duration(timing.jitter)}",
        f"  largest gap {_duration(timing.largest)} at {timing.largest_at:.6g} s"
        + (f"; gaps of at least {GAP:g} steps: {timing.gaps}" if timing.gaps else ""),
    ]
    if timing.backwards:
        lines.append(f"  {timing.backwards} time stamps repeat or go back")
    return lines


def _signal_lines(signal: "SignalSummary") -> list[str]:
    if math.isnan(signal.least):
        span = "no values"
    elif signal.is_constant:
        span = f"always {signal.least:.4g}"
    else:
        span = f"{signal.least:.4g} … {signal.greatest:.4g}"
    span = f"{span} {signal.unit}".strip()
    role = "" if signal.role == "other" else f"{signal.role}?"
    name = f"    {signal.name}"
    if len(name) > NAME_WIDTH:
        return [_cut(name), _cut(f"{'':{NAME_WIDTH}} {span:25} {role}".rstrip())]
    return [_cut(f"{name:{NAME_WIDTH}} {span:25} {role}".rstrip())]


def _duration(seconds: float) -> str:
    """Returns a short time in the unit that suits it."""
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if seconds * factor >= 1:
            return f"{seconds * factor:.4g} {unit}"
    return f"{seconds * 1e9:.3g} ns" if seconds >= 1e-9 else "0 s"


def _cut(line: str) -> str:
    line = "".join(c if c.isprintable() else "?" for c in line)
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 1]}…"


def _wrapped(text: str, indent: str = "") -> str:
    width = min(WIDTH, max(40, shutil.get_terminal_size().columns))
    text = "".join(c if c.isprintable() else "?" for c in text)
    return textwrap.fill(text, width, initial_indent=indent, subsequent_indent=f"{indent}  ")


def _without_nan(value: Any) -> Any:
    """Returns a value in which ``None`` stands for NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
