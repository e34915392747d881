"""`npdr demo`: a policy fails on a rig; discovery repairs the model; a new policy succeeds."""

from pathlib import Path

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.options import OutOption, SeedOption

__all__ = ["demo"]


def demo(
    out: OutOption = Path("demo-output"),
    seed: SeedOption = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Train a policy that fails on a rig, find the effects the model lacks, and train again.

    The rig is a Furuta pendulum in MuJoCo, while the model uses another engine. The rig has dry
    friction and filtered velocities that the model lacks. Writes figures and a report.

    To continue an interrupted run, give the same command again.

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

    # Batches are small here: a second thread makes training 25 % slower, and the search for
    # missing effects runs in its own processes.
    torch.set_num_threads(1)
    console = Console(quiet=quiet or as_json)
    console.print("The rig is a Furuta pendulum in MuJoCo; the model has the paper's equations …")
    with (
        resumable(f"the same command again continues the run in {out}."),
        workers(),
        reporter(False if quiet else None) as report,
    ):
        told = run_demo(out, seed=seed, progress=report)
        step = report.stage("draw figures, write the report")
        step(None, "returns, rollouts, parameters")
        write_training_figures(told.training, told.target, told.task, out)
        page = write_report(out)
        step(1.0, "")
    if as_json:
        typer.echo((out / "demo.json").read_text(), nl=False)
    elif not quiet:
        show_demo(told.result)
        console.print(f"Figures are in {out}/, the report is {page}")
