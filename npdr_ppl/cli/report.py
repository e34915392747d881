"""`npdr report`: writes a finished run as one HTML file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose

__all__ = ["report"]


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN", help="Folder that was passed as --out; several are compared."
        ),
    ],
    file: Annotated[
        Path | None,
        typer.Option(
            help="File to write; report.html in the run's folder by default, runs.html here for "
            "several runs."
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a finished run as one HTML file that opens anywhere, without a network.

    The report begins with the verdict and the key numbers. Charts, diagnostics in plain language,
    the model's source and the steps to reproduce the result follow.

    Several runs of the same model are shown side by side: parameters with intervals, effects found
    in each, gaps, and whether they agree.

    Example: npdr report monday tuesday --file week.html
    """
    from npdr_ppl.display.reports import write_report, write_runs_report

    if len(runs) > 1:
        path = write_runs_report(runs, file or Path("runs.html"))
    else:
        path = write_report(runs[0], file)
    if as_json:
        typer.echo(json.dumps({"report": str(path)}))
    elif not quiet:
        typer.echo(f"The report is in {path}")
