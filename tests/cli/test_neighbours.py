"""A file of the user's that is named on the command line imports the Python files beside it."""

import sys

import pytest

from npdr_ppl.cli.model_files import load_function
from npdr_ppl.engines.workers import Pool, WorkerOptions
from npdr_ppl.errors import ModelError
from npdr_ppl.python_files import is_importable

TASK = """
import numpy as np
from npdr_ppl.engines.workers import Task
from npdr_neighbour import Plant


class Moves(Task):
    def __init__(self):
        self.plant = Plant()

    def run(self, workspace, draw):
        from npdr_late_neighbour import GAIN

        return np.array([GAIN * self.plant.moved(draw.payload)])
"""

PLANT = """
class Plant:
    def moved(self, by):
        return by + {number}
"""


@pytest.fixture(autouse=True)
def untouched(monkeypatch):
    """Leaves path and modules as they were."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    for name in [name for name in sys.modules if name.startswith("npdr_")]:
        if name.endswith("neighbour"):
            del sys.modules[name]


def folder_with(folder, number):
    """Writes a file with a task, and the two files that it imports; returns the former."""
    folder.mkdir(exist_ok=True)
    (folder / "npdr_neighbour.py").write_text(PLANT.format(number=number))
    (folder / "npdr_late_neighbour.py").write_text("GAIN = 10.0\n")
    (folder / "task.py").write_text(TASK)
    return folder / "task.py"


@pytest.mark.parametrize("executor", ["serial", "loky"])
def test_worker_processes_find_the_neighbours(executor, tmp_path):
    task = load_function(folder_with(tmp_path, 1.0), "Moves")()
    with Pool(WorkerOptions(executor, None if executor == "serial" else 2)) as pool:
        assert pool.run(task, [0.0, 2.0]).values == [10.0, 30.0]
    # Results record the text of such files, unlike that of packages.
    assert not is_importable("npdr_neighbour")
    assert is_importable("npdr_ppl.models")


def test_neighbours_of_the_same_name_in_two_folders_are_refused(tmp_path):
    load_function(folder_with(tmp_path / "first", 1.0), "Moves")
    first = sys.modules["npdr_neighbour"]
    second = folder_with(tmp_path / "second", 2.0)
    for _ in range(2):
        with pytest.raises(ModelError, match=r"npdr_neighbour\.py, but another file has imported"):
            load_function(second, "Moves")
    assert sys.modules["npdr_neighbour"] is first
    # A file that does not import it may lie beside one.
    (tmp_path / "second" / "alone.py").write_text("def model(): pass\n")
    load_function(tmp_path / "second" / "alone.py", "model")
    assert sys.modules["npdr_neighbour"] is first


def test_a_neighbour_does_not_replace_a_library(tmp_path):
    (tmp_path / "wave.py").write_text("raise ImportError\n")
    (tmp_path / "model.py").write_text("import wave\nmodel = wave.open\n")
    load_function(tmp_path / "model.py", "model")


def test_a_missing_neighbour_is_named_with_what_to_do(tmp_path):
    (tmp_path / "model.py").write_text("import npdr_absent_neighbour\n")
    with pytest.raises(ModelError) as raised:
        load_function(tmp_path / "model.py", "model")
    assert "No module named 'npdr_absent_neighbour'" in str(raised.value)
    assert "put model.py into the same folder" in str(raised.value)
