"""`npdr models`, `npdr backends`, `npdr effects`: what there is to choose from."""

import json
from collections.abc import Sequence
from typing import Annotated

import typer

__all__ = ["backends", "effects", "models"]

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


def models(as_json: Json = False) -> None:
    """List the models of the zoo.

    Example: npdr models
    """
    from npdr_ppl.models import zoo

    rows = []
    for name, entry in zoo().items():
        simulator = entry.simulator
        rows.append(
            {
                "name": name,
                "summary": entry.summary,
                "parameters": [f"{p.name} [{p.unit}]" for p in simulator.parameters],
                "channels": [f"{c.name} [{c.unit}]" for c in simulator.sensors],
                "actions": [f"{c.name} [{c.unit}]" for c in simulator.actions],
                "ports": [f"{p.name} ({p.kind})" for p in simulator.ports],
            }
        )
    _show(rows, as_json)


def backends(as_json: Json = False) -> None:
    """List the inference backends.

    Example: npdr backends
    """
    from npdr_ppl.inference.registry import backends as registered

    _show([{"name": n, "summary": s} for n, s in registered().items()], as_json)


def effects(as_json: Json = False) -> None:
    """List the catalogue of effects.

    Example: npdr effects --json
    """
    from npdr_ppl.models.effects import effects as catalogue

    rows = [
        {
            "name": name,
            "summary": (effect.__doc__ or "").strip().splitlines()[0],
            "attaches to": list(effect.port_kinds),
            "parameters": [f"{p.name} [{p.unit}]" for p in effect.parameters],
        }
        for name, effect in catalogue().items()
    ]
    _show(rows, as_json)


def _show(rows: Sequence[dict[str, object]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(rows, indent=2, ensure_ascii=False))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(show_lines=True)
    for column in rows[0]:
        table.add_column(column)
    for row in rows:
        cells = ("\n".join(v) if isinstance(v, list) else str(v) for v in row.values())
        table.add_row(*cells)
    Console().print(table)
