"""`npdr demo`: from a policy that fails on a rig to what the model lacked, and to success."""

from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable

__all__ = ["demo"]


def demo(
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("demo-output"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Train a policy, find what the model lacks where it fails, and train it again.

    The rig is a Furuta pendulum in MuJoCo, another engine than the model's, with dry friction and
    filtered rates that the model knows nothing of. Figures and a report tell the story.

    Example: npdr demo --out demo-output
    """
    import torch
    from rich.console import Console

    from npdr_ppl.cli.show import show_demo
    from npdr_ppl.display.plots.training_figures import write_training_figures
    from npdr_ppl.display.reports import write_report
    from npdr_ppl.engines.workers import workers
    from npdr_ppl.progress import reporter
    from npdr_ppl.reproduction.demo import run_demo

    # Batches are small here: a second thread makes training a fourth slower, and the search of
    # discovery has its processes.
    torch.set_num_threads(1)
    console = Console(quiet=quiet or as_json)
    console.print("A Furuta pendulum in MuJoCo is the rig; the model has the paper's equations …")
    with (
        resumable(f"the same command again continues the run in {out}."),
        workers(),
        reporter(False if quiet else None) as report,
    ):
        told = run_demo(out, seed=seed, progress=report)
        step = report.stage("draw figures, write the report")
        step(0.0, "returns, rollouts, parameters")
        write_training_figures(told.training, told.target, told.task, out)
        page = write_report(out)
        step(1.0, "")
    if as_json:
        typer.echo((out / "demo.json").read_text(), nl=False)
    elif not quiet:
        show_demo(told.result)
        console.print(f"Figures are in {out}/, the whole story in {page}")
