"""The command line, run inside a test's own process."""

import contextlib
import io
import sys

import pytest

from npdr_ppl.cli import main as cli


def run(monkeypatch, capsys, *words):
    """Runs the command line in this process; returns exit code, output and error text."""
    monkeypatch.setattr(sys, "argv", ["npdr", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    out, err = capsys.readouterr()
    return stop.value.code or 0, out, err


def run_for_module(*words):
    """Does the same in a fixture of a module, which has neither ``monkeypatch`` nor ``capsys``."""
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as stop,
    ):
        patch.setattr(sys, "argv", ["npdr", *map(str, words)])
        cli.main()
    return stop.value.code or 0, out.getvalue(), err.getvalue()


def assert_prints_sentence(text, preparation):
    """Fails unless a command's output has the line about its recording's preparation.

    Args:
        text: The output.
        preparation: The same preparation in the command's JSON.
    """
    sentence = preparation["sentence"]
    assert sentence.startswith("Prepared: segments of")
    # Terminals break the line.
    assert sentence in " ".join(text.split())
