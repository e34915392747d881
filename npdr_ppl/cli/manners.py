"""What commands have in common: how much they say, as what, and how they take an interruption."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

__all__ = ["INTERRUPTED", "AsJson", "Quiet", "Verbose", "resumable"]

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def _log(is_wanted: bool) -> None:
    """Has the package's log written to standard error."""
    if is_wanted:
        logger = logging.getLogger("npdr_ppl")
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
# The callback does everything, so commands need not look at the value.
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", callback=_log, help="Log to standard error what is done."),
]


@contextmanager
def resumable(how: str) -> Iterator[None]:
    """Answers Ctrl-C inside the block with how to go on, and with the shells' exit code.

    Args:
        how: What continues the run, to follow "interrupted; ".
    """
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"npdr: interrupted; {how}", err=True)
        raise typer.Exit(INTERRUPTED) from None
