"""What `npdr inspect` says about a model in Python or of the zoo, as about a robot's file."""

import json
import math
from typing import TYPE_CHECKING, Any

import typer

from npdr_ppl.cli.robots import column_lines, in_columns, port_lines

if TYPE_CHECKING:
    from npdr_ppl.language.model import Model
    from npdr_ppl.language.prior import Prior

__all__ = ["inspect_model"]

_QUANTILE = 1.959964
"""Standard normal quantile of 97.5 %; 95 % of a prior lie between it and its negative."""


def inspect_model(word: str, as_json: bool) -> None:
    """Prints a model's parameters, the columns that a log needs, and its ports.

    Args:
        word: The model as in ``npdr fit MODEL``.
        as_json: Whether to print JSON.

    Raises:
        ModelError: There is no such model, or it has not one simulator.
    """
    from npdr_ppl.cli.resolve import resolve_model

    found = _described(word, resolve_model(word))
    if as_json:
        typer.echo(json.dumps(found, indent=2, ensure_ascii=False))
        return
    for line in _lines(found):
        typer.echo("".join(c if c.isprintable() else "?" for c in line))
    typer.echo(f"\n    npdr fit {word} --data LOG --out fit")


def _described(word: str, model: "Model") -> dict[str, Any]:
    """Returns what is known of a model, for JSON."""
    import torch

    from npdr_ppl.language.inputs import Inputs
    from npdr_ppl.language.only_simulator import only_simulator
    from npdr_ppl.language.prior import Prior
    from npdr_ppl.language.wider_priors import described_prior
    from npdr_ppl.posterior.parameter_units import parameter_units

    simulator = only_simulator(model)[0].simulator
    nothing = Inputs.single(
        torch.zeros(1, 0), torch.zeros(0), action_names=(), state_names=(), time_step=1.0
    )
    prior = Prior(model, (nothing,))
    units, ranges = parameter_units(prior), _ranges(prior)
    declared = {p.name: p for p in simulator.parameters}
    rates = {state.name: state.rate_of for state in simulator.states}
    return {
        "model": word,
        "simulator": simulator.name,
        "time step": simulator.time_step,
        "parameters": [
            {
                "name": site.name,
                "unit": units.get(site.name, ""),
                "nominal": declared[site.name].nominal if site.name in declared else None,
                "prior": ranges[site.name],
                "family": described_prior(prior.distributions[site.name]),
                "description": declared[site.name].description if site.name in declared else "",
            }
            for site in prior.sites
        ],
        "columns": [
            {
                "name": c.name,
                "unit": c.unit,
                "role": role,
                "range": [c.lower, c.upper] if math.isfinite(c.upper - c.lower) else None,
                "may be left out": role == "measurement" and rates.get(c.name) is not None,
            }
            for role, channels in (
                ("measurement", simulator.sensors),
                ("command", simulator.actions),
            )
            for c in channels
        ],
        "ports": [{"name": p.name, "kind": p.kind, "unit": p.unit} for p in simulator.ports],
    }


def _ranges(prior: "Prior") -> dict[str, list[float] | None]:
    """Returns the middle 95 % of each site's prior, where the others are at their medians.

    A uniform prior's are its ends; a site of several numbers has ``None``.
    """
    import torch

    ranges: dict[str, list[float] | None] = {}
    for site in prior.sites:
        ranges[site.name] = None
        if math.prod(site.shape) != 1 or site.coordinates.stop - site.coordinates.start != 1:
            continue
        if prior.uniform_coordinates[site.coordinates].all():
            support = prior.distributions[site.name].support
            ends = torch.tensor([float(support.lower_bound), float(support.upper_bound)])
        else:
            z = torch.zeros(2, prior.num_parameters, dtype=torch.float64)
            z[:, site.coordinates] = torch.tensor([[-_QUANTILE], [_QUANTILE]], dtype=z.dtype)
            ends = prior.to_parameters(z)[site.name]
        # Six digits, because a prior of float32 has no more.
        ranges[site.name] = sorted(float(f"{end:.6g}") for end in ends.flatten().tolist())
    return ranges


def _lines(found: dict[str, Any]) -> list[str]:
    """Returns the description as text."""
    step, parameters = found["time step"], found["parameters"]
    rows = [("parameter", "nominal", "prior", "unit", "")]
    for p in parameters:
        nominal = "–" if p["nominal"] is None else f"{p['nominal']:.4g}"
        ends = "–" if p["prior"] is None else "{:.4g} … {:.4g}".format(*p["prior"])
        is_uniform = p["family"].startswith("Uniform")
        mark = "" if p["prior"] is None or is_uniform else "*"
        about = "; ".join(filter(None, ["" if is_uniform else p["family"], p["description"]]))
        rows.append((p["name"], nominal, ends + mark, p["unit"], about))
    lines = [
        f"{found['model']}: {len(parameters)} parameters of {found['simulator']}, time step "
        f"{step:g} s ({1 / step:.4g} Hz)",
        "",
        *in_columns(rows),
    ]
    if any(row[2].endswith("*") for row in rows):
        lines.append("  * the range has 95 % of it")
    hint = f"npdr inspect LOG --model {found['model']} --write MAPPING"
    return [*lines, "", *column_lines(found, hint), "", *port_lines(found)]
