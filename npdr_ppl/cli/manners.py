"""Options that the commands share (--quiet, --json, --verbose); Ctrl-C and the like."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

__all__ = [
    "INTERRUPTED",
    "INTERRUPTIONS",
    "AsJson",
    "Commands",
    "Interrupted",
    "Quiet",
    "Stopped",
    "Verbose",
    "exit_code",
    "resumable",
    "stop_on_signals",
]


INTERRUPTED = 130
"""Exit code after Ctrl-C, the same as in shells."""


INTERRUPTIONS = (INTERRUPTED, 143, 129)
"""Exit codes after Ctrl-C, SIGTERM and SIGHUP."""


AGAIN_SECONDS = 0.05
"""Seconds until a dropped signal is sent again. The finaliser should have returned by then."""


_received: list[int] = []
"""Numbers of the signals that came. Ray replaces :class:`Stopped` by a bare exception."""


class Stopped(KeyboardInterrupt):
    """SIGTERM, or SIGHUP from a closed terminal, came; it is handled like Ctrl-C.

    It is a ``KeyboardInterrupt`` because Ray's compiled code waits on after any other exception.

    Attributes:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Interrupted(BaseException):
    """A command was interrupted. typer would make an exit code of a ``KeyboardInterrupt``."""


class Commands(TyperGroup):
    """Commands that pass on interruptions as :class:`Interrupted`."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise Interrupted from error


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Lets SIGTERM and SIGHUP raise :class:`Stopped` inside the block, unless they are ignored.

    Python drops exceptions in finalisers and around a fork. If it drops :class:`Stopped`, the
    signal is sent again, until the exception reaches the command.
    """
    _received.clear()
    replaced = {}
    before = sys.unraisablehook
    timers: list[threading.Timer] = []

    def send_again(dropped: Any) -> None:
        if isinstance(dropped.exc_value, Stopped):
            number = dropped.exc_value.number
            signal.signal(number, _stop)
            # Later, because Python drops what is raised in here, too.
            again = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            timers.append(again)
        else:
            before(dropped)

    if threading.current_thread() is threading.main_thread():  # others may not handle signals
        for name in ("SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                replaced[number] = signal.signal(number, _stop)
        sys.unraisablehook = send_again
    try:
        yield
    finally:
        sys.unraisablehook = before
        for timer in timers:
            timer.cancel()
        for number, handler in replaced.items():
            signal.signal(number, handler)


def exit_code() -> int:
    """Returns the exit code after an interruption, the same as in shells."""
    return 128 + _received[-1] if _received else INTERRUPTED


def _stop(number: int, frame: Any) -> None:
    _received.append(number)
    signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
    raise Stopped(number)


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
    """When the block is interrupted, prints how to continue and exits with the shells' code.

    Args:
        how: How to continue the run; printed after "interrupted; ".
    """
    try:
        yield
    except BaseException as error:
        if not _is_interruption(error):
            raise
        typer.echo(f"npdr: interrupted; {how}", err=True)
        raise typer.Exit(exit_code()) from None


def _is_interruption(error: BaseException | None) -> bool:
    """Returns whether an error is an interruption, or one that compiled code disguised.

    Compiled code, such as Ray's, may turn an interruption into a ``SystemError``. Other errors
    that follow an interruption, such as a device that cannot be switched off, remain errors.
    """
    while isinstance(error, SystemError):
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return isinstance(error, KeyboardInterrupt)
