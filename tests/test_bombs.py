"""Small files that describe much: each is read or refused with one sentence, at little cost."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import (
    cost_server,
    log_bombs,
    robot_bombs,
    run_bombs,
    table_bombs,
    tree_bombs,
)

BOMBS = table_bombs.BOMBS | tree_bombs.BOMBS | robot_bombs.BOMBS | run_bombs.BOMBS
ALL = BOMBS | log_bombs.BOMBS
CASES = [(kind, name) for kind, bombs in ALL.items() for name in bombs]

MAX_SECONDS = 2.0
MAX_MEGABYTES = 500.0

ATTEMPTS = 3
"""Readings of a file that seems slow: what else runs on the machine can only add to its time."""


@pytest.fixture(scope="module")
def cost():
    """Returns a function that reads a file in a process of its own and returns the cost."""
    root = Path(__file__).resolve().parents[1]
    with subprocess.Popen(
        [sys.executable, cost_server.__file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ
        | {
            "PYTHONPATH": os.pathsep.join((str(root), str(root / "benchmarks"))),
            "OMP_NUM_THREADS": "1",
        },
    ) as process:

        def ask(kind, path):
            process.stdin.write(json.dumps([kind, str(path)]) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        assert process.stdout.readline() == "ready\n"
        yield ask


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_bombs_cost_little(kind, name, cost, tmp_path):
    path = tmp_path / f"bomb.{kind.removeprefix('log_')}"
    ALL[kind][name](path)
    for _ in range(ATTEMPTS):
        answer = cost(kind, path)
        if answer["seconds"] < MAX_SECONDS:
            break
    assert answer["outcome"] in ("read", "refused"), answer
    assert answer["seconds"] < MAX_SECONDS, answer
    assert answer["megabytes"] < MAX_MEGABYTES, answer


@pytest.mark.parametrize("kind", ["lerobot", "folder"])
def test_links_out_of_a_folder_are_not_followed(kind, cost, tmp_path):
    log_bombs.BOMBS[kind][f"{kind}_of_a_link"](tmp_path / "set")
    answer = cost(kind, tmp_path / "set")
    assert answer["outcome"] == "refused" and "is a link out of the folder" in answer["message"]


def test_there_are_at_least_eight_of_each_format():
    assert all(len(bombs) >= 8 for bombs in BOMBS.values())
