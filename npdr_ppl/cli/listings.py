"""`npdr models`, `npdr backends`, `npdr targets` and so on: what there is to choose from."""

import json
from collections.abc import Sequence

import typer

from npdr_ppl.cli.manners import AsJson

__all__ = ["backends", "effects", "models", "searches", "targets", "tasks"]


def models(as_json: AsJson = False) -> None:
    """List the models of the zoo.

    Example: npdr models
    """
    from npdr_ppl.models import zoo

    rows = []
    for name, entry in zoo().items():
        simulator = entry.simulator()
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


def backends(as_json: AsJson = False) -> None:
    """List the inference backends.

    Example: npdr backends
    """
    from npdr_ppl.inference.registry import backends as registered

    _show([{"name": n, "summary": s} for n, s in registered().items()], as_json)


def effects(as_json: AsJson = False) -> None:
    """List the catalogue of effects.

    Example: npdr effects --json
    """
    from npdr_ppl.models.effects import effects as catalogue

    rows = [
        {
            "name": name,
            "summary": effect.law or _first_line(effect),
            "attaches to": list(effect.port_kinds),
            "parameters": [f"{p.name} [{_unit(p.unit)}]" for p in effect.parameters],
            "not told from": [c.name for c in effect.equivalence],
            "revealed by": effect.excitation,
        }
        for name, effect in catalogue().items()
    ]
    _show(rows, as_json)


def targets(as_json: AsJson = False) -> None:
    """List the target domains of the zoo.

    Example: npdr targets
    """
    from npdr_ppl.models import targets as registered

    rows = []
    for name, entry in registered().items():
        target = entry.make()
        rows.append(
            {
                "name": name,
                "summary": entry.summary,
                "channels": [f"{c.name} [{c.unit}]" for c in target.sensors],
                "actions": [f"{c.name} [{c.unit}]" for c in target.actions],
                "time step": f"{target.time_step:g} s",
            }
        )
    _show(rows, as_json)


def tasks(as_json: AsJson = False) -> None:
    """List what policies can be trained to do.

    Example: npdr tasks
    """
    from npdr_ppl.loop.control_task import control_task, control_tasks

    rows = []
    for name in control_tasks():
        task = control_task(name)
        rows.append(
            {
                "name": name,
                "summary": _first_line(task.policy),
                "reads": list(task.policy.observations),
                "commands": list(task.policy.actions),
                "steps": task.num_steps,
                "success": "–" if task.success is None else f"return above {task.success:g}",
            }
        )
    _show(rows, as_json)


def searches(as_json: AsJson = False) -> None:
    """List the policy searches.

    Example: npdr searches
    """
    from npdr_ppl.policies.search_registry import policy_searches

    _show([{"name": n, "summary": s} for n, s in policy_searches().items()], as_json)


def _unit(template: str) -> str:
    """Returns an effect's unit in words where it depends on the port."""
    return template.format(port="port", coordinate="coordinate")


def _first_line(documented: object) -> str:
    return (documented.__doc__ or "").strip().partition("\n")[0]


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
