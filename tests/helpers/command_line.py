"""The command line, run inside a test's own process."""

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
