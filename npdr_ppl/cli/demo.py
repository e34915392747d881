"""`npdr demo`: from a recording to a posterior in two minutes."""

from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.fit import InitialState
from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable

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
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
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
    from npdr_ppl.workflows.progress import reporter

    console = Console(quiet=quiet or as_json)
    console.print(
        "Recording a Furuta pendulum in MuJoCo, with parameters unlike the nominal ones …"
        if data is None
        else f"Reading {data} …"
    )
    with (
        resumable(f"the same command again continues the run in {out}."),
        reporter(False if quiet else None) as report,
    ):
        outcome = run_demo(
            out, data=data, initial_state=initial_state.value, seed=seed, progress=report
        )
        marks = {"truth": outcome.truth} if outcome.truth else None
        paths = write_fit_figures(
            outcome.posterior,
            furuta,
            outcome.test,
            out,
            marks=marks,
            seed=seed,
            progress=report.stage("draw figures"),
        )
    if as_json:
        typer.echo((out / "fit.json").read_text(), nl=False)
    elif not quiet:
        show_fit(outcome.result, out)
        console.print("Look at " + ", ".join(str(path) for path in paths))
