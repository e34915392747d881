"""Entry point of `npdr`: registers the commands; bad input gives one sentence and exit code 2."""

import logging
import os
import sys
from typing import Any

import typer

from npdr_ppl.cli import (
    compare,
    demo,
    discover,
    export,
    fit,
    listings,
    logs,
    plan,
    report,
    reproduce,
    train,
)
from npdr_ppl.cli.manners import (
    INTERRUPTIONS,
    Commands,
    Interrupted,
    exit_code,
    stop_on_signals,
)
from npdr_ppl.errors import NpdrError

__all__ = ["app", "main", "run"]

COMPLETES = "_NPDR_COMPLETE"
"""Environment variable by which a shell asks for completions."""

# Base class of the errors for wrong options, values and commands.
_UsageError: Any = typer.BadParameter.__bases__[0]

app = typer.Typer(
    name="npdr",
    cls=Commands,
    help="Probabilistic programming for robot simulators.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.command(rich_help_panel="See it work")(demo.demo)
app.command(rich_help_panel="Read logs")(logs.inspect)
app.command(rich_help_panel="Read logs")(logs.convert)
app.command(rich_help_panel="Infer parameters")(fit.fit)
app.command(rich_help_panel="Infer parameters")(compare.compare)
app.command(rich_help_panel="Find what is missing")(discover.discover)
app.command(rich_help_panel="Find what is missing")(plan.plan)
app.command(rich_help_panel="Train policies")(train.train)
app.command(rich_help_panel="Show results")(report.report)
app.command(rich_help_panel="Show results")(export.export)
app.command(rich_help_panel="See it work")(reproduce.reproduce)
app.command("models", rich_help_panel="What there is")(listings.models)
app.command("backends", rich_help_panel="What there is")(listings.backends)
app.command("effects", rich_help_panel="What there is")(listings.effects)
app.command("targets", rich_help_panel="What there is")(listings.targets)
app.command("tasks", rich_help_panel="What there is")(listings.tasks)
app.command("searches", rich_help_panel="What there is")(listings.searches)


def main() -> None:
    """Runs the command line."""
    # Waiting threads of torch would spin and slow down a busy machine. OpenMP reads this variable
    # when torch is first imported, which happens after this line.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # After an interruption, the process that removes the files of workers would name each of them.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")
    try:
        with stop_on_signals():
            sys.exit(_run() or 0)
    except (Interrupted, KeyboardInterrupt):
        typer.echo("npdr: interrupted.", err=True)
        sys.exit(exit_code())
    except _UsageError as error:
        where = error.ctx.command_path if error.ctx else "npdr"
        _refuse(f"{_sentence(error.format_message())}{_repeating(error)} See {where} --help.")
    except NpdrError as error:
        _refuse(str(error))
    except OSError as error:
        _refuse(f"{error.filename or 'A file'}: {error.strerror or error}.")


def run() -> None:
    """Runs the command line as a program, which ends at once after an interruption.

    Python would take seconds to free its modules. Results are complete or not written at all, and
    workers end with this process.
    """
    try:
        main()
    except SystemExit as stop:
        if stop.code in INTERRUPTIONS:
            logging.shutdown()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(stop.code))
        raise


def _run() -> Any:
    """Runs the command; returns its exit code."""
    is_completion = COMPLETES in os.environ or any(
        word.split("=")[0] in ("--install-completion", "--show-completion") for word in sys.argv
    )
    if len(sys.argv) < 2 or is_completion:
        # Then typer itself prints and ends the program.
        return app(standalone_mode=not is_completion)
    try:
        return app(standalone_mode=False)
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # `npdr ... | head` has read enough
            raise
        _refuse(f"The model or its simulator ended the program by sys.exit({error.code!r}).")


def _repeating(error: Any) -> str:
    """Returns how to give an option several values, if that was the mistake."""
    is_extra = "unexpected extra argument" in error.format_message()
    options = error.ctx.command.params if is_extra and error.ctx else ()
    given = [o.opts[0] for o in options if getattr(o, "multiple", False) and o.opts[0] in sys.argv]
    return f" Give {given[0]} before each of its values." if given else ""


def _sentence(message: str) -> str:
    line = " ".join(message.split())
    return line if line.endswith((".", "?", "!")) else f"{line}."


def _refuse(sentence: str) -> None:
    # Messages of other libraries have several lines, and texts from files any characters.
    sentence = " ".join(sentence.split())
    sentence = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in sentence)
    typer.echo(f"npdr: {sentence}", err=True)
    sys.exit(2)
