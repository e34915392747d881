"""The code of a model: what it needs of its file, of the files beside it and of those it names."""

import sys

import pytest

import npdr_ppl as npdr
from npdr_ppl.cli.model_files import load_function
from npdr_ppl.discovery.revised_model import revised_source
from npdr_ppl.model_code import code_checksum, code_of
from npdr_ppl.models.effects import Bias, CoulombFriction
from npdr_ppl.models.pendulum import pendulum

MODEL = """
import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_code_neighbour import Plant

TITLE = "a plot's"


def own(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    return npdr.simulate("trajectory", Plant("robot.txt"), {"mass": mass}, inputs, noise=0.1)
"""

NEIGHBOUR = """
from pathlib import Path

from npdr_ppl.models.pendulum import Pendulum


class Plant(Pendulum):
    def __init__(self, file):
        super().__init__()
"""


@pytest.fixture(autouse=True)
def untouched(monkeypatch):
    """Leaves path and modules as they were."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    sys.modules.pop("npdr_code_neighbour", None)


@pytest.fixture
def folder(tmp_path):
    """Returns a folder with a model, a file that it imports and one that it names."""
    (tmp_path / "own.py").write_text(MODEL)
    (tmp_path / "npdr_code_neighbour.py").write_text(NEIGHBOUR)
    (tmp_path / "robot.txt").write_text("1 kg")
    return tmp_path


def checksum_after(folder, name, old, new):
    """Returns the checksum of the folder's model after a change of one of the files."""
    file = folder / name
    before = file.read_text()
    assert old in before
    file.write_text(before.replace(old, new))
    try:
        return code_checksum(load_function(folder / "own.py", "own"))
    finally:
        file.write_text(before)


@pytest.mark.parametrize(
    ("name", "old", "new", "counts"),
    [
        ("own.py", "0.3, 1.7", "0.3, 1.8", True),
        ("own.py", "a plot's", "a figure's", False),
        ("own.py", "def own", "# a comment\ndef own", False),
        ("npdr_code_neighbour.py", "super().__init__()", "super().__init__() or print()", True),
        ("npdr_code_neighbour.py", "class", "# a comment\nclass", False),
        ("robot.txt", "1 kg", "2 kg", True),
    ],
)
def test_a_change_counts_where_the_model_needs_it(folder, name, old, new, counts):
    before = code_checksum(load_function(folder / "own.py", "own"))
    assert (checksum_after(folder, name, old, new) != before) == counts


def test_effects_count_but_not_the_noise():
    rubbed = npdr.add_effect(pendulum, CoulombFriction("hinge"))
    assert code_checksum(rubbed) != code_checksum(pendulum)
    assert code_checksum(rubbed) != code_checksum(npdr.add_effect(pendulum, Bias("hinge")))
    assert code_checksum(npdr.with_noise(rubbed, 0.1)) == code_checksum(rubbed)


def test_a_model_without_a_file_has_no_code():
    assert code_of(eval("lambda inputs: None")).text == ""


def test_a_revised_model_that_needs_other_files_works_in_another_folder(folder, tmp_path_factory):
    model = load_function(folder / "own.py", "own")
    code = code_of(model)
    assert [file.name for file in code.neighbours] == ["npdr_code_neighbour.py"]
    assert code.named == (folder / "robot.txt",) and not code.is_alone
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "revised_model.py"
    elsewhere.write_text(revised_source(model, (CoulombFriction("hinge"),), {"mass": 1.0}))
    for name in [name for name in sys.modules if name.startswith(("_npdr_", "npdr_code_"))]:
        del sys.modules[name]
    revised = load_function(elsewhere, "revised_model")
    assert code_of(revised).file == folder / "own.py"
