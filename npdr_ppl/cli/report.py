"""`npdr report`: writes a finished run as one HTML file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose

__all__ = ["report"]


def report(
    run: Annotated[Path, typer.Argument(help="Folder that was passed as --out.")],
    file: Annotated[
        Path | None,
        typer.Option(help="File to write; report.html in the run's folder by default."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a finished run as one HTML file that opens anywhere, without a network.

    The report begins with the verdict and the key numbers. Charts, diagnostics in plain language,
    the model's source and the steps to reproduce the result follow.

    Example: npdr report fit --file fit.html
    """
    from npdr_ppl.display.reports import write_report

    path = write_report(run, file)
    if as_json:
        typer.echo(json.dumps({"report": str(path)}))
    elif not quiet:
        typer.echo(f"The report is in {path}")
