"""`npdr models`, `npdr backends`, `npdr targets` and so on: what there is to choose from."""

import json
import shutil
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from npdr_ppl.cli.manners import AsJson
from npdr_ppl.cli.names import (
    complete_backend,
    complete_effect,
    complete_model,
    complete_search,
    complete_target,
    complete_task,
)
from npdr_ppl.errors import DataError
from npdr_ppl.registry import hint

__all__ = ["backends", "effects", "models", "searches", "targets", "tasks"]

DETAILS = "Name of one entry, to show all its details."


def models(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_model),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the models of the zoo.

    Example: npdr models
    """
    from npdr_ppl.models import zoo

    rows = []
    for key, entry in zoo().items():
        simulator = entry.simulator()
        rows.append(
            {
                "name": key,
                "summary": entry.summary,
                "parameters": [f"{p.name} [{p.unit}]" for p in simulator.parameters],
                "channels": [f"{c.name} [{c.unit}]" for c in simulator.sensors],
                "actions": [f"{c.name} [{c.unit}]" for c in simulator.actions],
                "ports": [f"{p.name} ({p.kind})" for p in simulator.ports],
            }
        )
    _show("models", rows, name, as_json)


def backends(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_backend),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the inference backends.

    Example: npdr backends
    """
    from npdr_ppl.inference.registry import backends as registered

    _show("backends", [{"name": n, "summary": s} for n, s in registered().items()], name, as_json)


def effects(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_effect),
    ] = None,
    add: Annotated[
        Path | None,
        typer.Option(
            help="Python file of your own whose effects to add, for every later command."
        ),
    ] = None,
    remove: Annotated[
        str, typer.Option(help="Effect that you added, to be removed with its file.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """List the catalogue of effects and those that you added; add your own.

    --add copies a Python file to the folder that NPDR_EFFECTS names, or else to
    npdr_ppl/effects among your data. Every later search tries its effects.

    Example: npdr effects --json
    """
    from npdr_ppl.models.effects import effects as registered
    from npdr_ppl.models.effects.added import added_effects

    if (name is not None) + (add is not None) + bool(remove) > 1:
        raise DataError("`npdr effects` takes one of a name, --add and --remove.")
    if add is not None or remove:
        _change_effects(add, remove, as_json)
        return
    catalogue = registered()
    rows: list[dict[str, object]] = [
        {
            "name": key,
            "summary": effect.law or _first_line(effect),
            "attaches to": list(effect.port_kinds),
            "parameters": [f"{p.name} [{_unit(p.unit)}]" for p in effect.parameters],
            "priors at rated values of 1": _priors(effect),
            "may be confused with": [c.name for c in effect.equivalence],
            "revealed by": effect.excitation,
        }
        for key, effect in catalogue.items()
    ]
    files = {own.effect: str(own.file) for own in added_effects().values()}
    for row, effect in zip(rows, catalogue.values(), strict=True):
        if effect in files:
            row["file"] = files[effect]
    _show("effects", rows, name, as_json)


def _priors(effect: Any) -> list[str]:
    """Returns the priors of an effect's parameters at a port whose rated values are all one."""
    from npdr_ppl.language.channels import Port
    from npdr_ppl.language.wider_priors import described_prior

    kind = effect.port_kinds[0]
    priors = effect("port").default_priors(Port("port", kind, "1"))
    return [f"{name}: {described_prior(prior)}" for name, prior in priors.items()]


def _change_effects(add: Path | None, remove: str, as_json: bool) -> None:
    """Adds the effects of a file, or removes those of an added file, and says which.

    Raises:
        ModelError: The file is refused, or the effect is not an added one.
    """
    from npdr_ppl.models.effect_additions import add_file, remove_file

    changed = add_file(add) if add is not None else remove_file(remove)
    names = ", ".join(changed.ids) or "a file without effects"
    verb = "removed" if add is None else "added"
    if as_json:
        typer.echo(json.dumps({verb: list(changed.ids), "file": str(changed.file)}, indent=2))
        return
    typer.echo(f"{verb.capitalize()} {names}: {changed.file}")
    if changed.unchecked:
        typer.echo(
            f"Not tried: {', '.join(changed.unchecked)}. No model of the zoo has a port for it."
        )
    if add is not None:
        typer.echo(f"Attach it with --effect PORT.{changed.ids[0]}; npdr discover tries it.")


def targets(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_target),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the target domains of the zoo.

    Example: npdr targets
    """
    from npdr_ppl.models import targets as registered

    rows = []
    for key, entry in registered().items():
        target = entry.make()
        rows.append(
            {
                "name": key,
                "summary": entry.summary,
                "channels": [f"{c.name} [{c.unit}]" for c in target.sensors],
                "actions": [f"{c.name} [{c.unit}]" for c in target.actions],
                "time step": f"{target.time_step:g} s",
            }
        )
    _show("targets", rows, name, as_json)


def tasks(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_task),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List what policies can be trained to do.

    Example: npdr tasks
    """
    from npdr_ppl.loop.control_task import control_task, control_tasks

    rows = []
    for key in control_tasks():
        task = control_task(key)
        rows.append(
            {
                "name": key,
                "summary": _first_line(task.policy),
                "reads": list(task.policy.observations),
                "commands": list(task.policy.actions),
                "steps": task.num_steps,
                "success": "–" if task.success is None else f"return above {task.success:g}",
            }
        )
    _show("tasks", rows, name, as_json)


def searches(
    name: Annotated[
        str | None,
        typer.Argument(help=DETAILS, autocompletion=complete_search),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the policy searches.

    Example: npdr searches
    """
    from npdr_ppl.policies.search_registry import policy_searches

    _show(
        "searches",
        [{"name": n, "summary": s} for n, s in policy_searches().items()],
        name,
        as_json,
    )


def _unit(template: str) -> str:
    """Returns an effect's unit in words where it depends on the port."""
    return template.format(port="port", coordinate="coordinate", force="force")


def _first_line(documented: object) -> str:
    return (documented.__doc__ or "").strip().partition("\n")[0]


def _show(
    command: str, rows: Sequence[dict[str, object]], name: str | None, as_json: bool
) -> None:
    """Prints names with a line about each, or all details of one.

    Args:
        command: The command that lists them.
        rows: What is known of each; ``name`` is the word to type.
        name: Whose details to show; ``None`` lists all.
        as_json: Whether to print all details as JSON.

    Raises:
        DataError: There is no such name.
    """
    if name is not None:
        chosen = [row for row in rows if row["name"] == name]
        if not chosen:
            known = [str(row["name"]) for row in rows]
            raise DataError(f"`npdr {command}` lists no {name!r}; {hint(name, known)}")
        rows = chosen
    if as_json:
        typer.echo(json.dumps(rows, indent=2, ensure_ascii=False))
    elif name is not None:
        typer.echo(_details(rows[0]))
    else:
        for row in rows:
            typer.echo(f"{row['name']}\n{_wrapped(str(row['summary']))}")
            if "file" in row:
                typer.echo(_wrapped(f"of your own, in {row['file']}"))
        if set(rows[0]) > {"name", "summary"}:
            typer.echo(f"\nDetails: npdr {command} {rows[0]['name']}")


def _details(row: dict[str, object]) -> str:
    """Returns the details of one entry, with a heading for each kind."""
    lines = [str(row["name"]), _wrapped(str(row["summary"]))]
    for key, value in row.items():
        if key in ("name", "summary"):
            continue
        values = [str(v) for v in value] if isinstance(value, list) else [str(value)]
        lines += [f"{key}:", *(_wrapped(v) for v in values or ["none"])]
    return "\n".join(lines)


def _wrapped(text: str) -> str:
    """Returns a text in lines that fit the terminal, indented below its name."""
    width = max(40, shutil.get_terminal_size().columns)
    # Neither at hyphens nor within words, so that names can be typed as they are shown.
    return textwrap.fill(
        text,
        width,
        initial_indent="    ",
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
