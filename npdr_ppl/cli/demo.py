"""`npdr demo`: from a recording to a posterior in two minutes."""

from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.fit import InitialState

__all__ = ["demo"]


def demo(
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("demo-output"),
    data: Annotated[
        Path | None,
        typer.Option(help="Your own Furuta recording instead of a synthetic one."),
    ] = None,
    initial_state: Annotated[
        InitialState, typer.Option(help="State at a segment's start.")
    ] = InitialState.ESTIMATED,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Fit the Furuta pendulum to a recording, and draw what was learnt.

    Without --data the recording is made by MuJoCo, another engine than the one that is fitted,
    with perturbed parameters; the figures then show the truth as well.

    Example: npdr demo --out demo-output
    """
    from rich.console import Console

    from npdr_ppl.cli.show import show_fit
    from npdr_ppl.models.furuta import furuta
    from npdr_ppl.plots.fit_figures import write_fit_figures
    from npdr_ppl.workflows.demo import run_demo

    console = Console(quiet=quiet)
    console.print(
        "Recording a Furuta pendulum in MuJoCo, with parameters unlike the nominal ones …"
        if data is None
        else f"Reading {data} …"
    )
    outcome = run_demo(
        out,
        data=data,
        initial_state=initial_state.value,
        seed=seed,
        progress=False if quiet else None,
    )
    marks = {"truth": outcome.truth} if outcome.truth else None
    paths = write_fit_figures(outcome.posterior, furuta, outcome.test, out, marks=marks, seed=seed)
    if not quiet:
        show_fit(outcome.result, out)
        console.print("Look at " + ", ".join(str(path) for path in paths))
