"""Options that the commands share (--quiet, --json, --verbose), and the handling of Ctrl-C."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

__all__ = ["INTERRUPTED", "AsJson", "Quiet", "Verbose", "resumable"]

INTERRUPTED = 130
"""Exit code after Ctrl-C, the same as in shells."""


def _log(is_wanted: bool) -> None:
    """Writes the package's log to standard error."""
    if is_wanted:
        logger = logging.getLogger("npdr_ppl")
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
# The callback sets up the log, so commands ignore the value.
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", callback=_log, help="Log progress to standard error."),
]


@contextmanager
def resumable(how: str) -> Iterator[None]:
    """On Ctrl-C inside the block, prints how to continue the run and exits with the shells' code.

    Args:
        how: How to continue the run; printed after "interrupted; ".
    """
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"npdr: interrupted; {how}", err=True)
        raise typer.Exit(INTERRUPTED) from None
