"""The code of a model: what it needs of its file, of the files beside it and of those it names."""

import os
import subprocess
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
    for name in [name for name in sys.modules if name.startswith("npdr_code_")]:
        del sys.modules[name]


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


@pytest.mark.parametrize("module", ["npdr_code_space", "npdr_code_package"])
def test_packages_beside_a_model_count_with_all_their_files(folder, module):
    package = folder / module
    package.mkdir()
    if module == "npdr_code_package":
        (package / "__init__.py").write_text("")
    (package / "plant.py").write_text(NEIGHBOUR)
    (package / "template.py").write_text("class {{ name }}:\n")
    file = folder / "own.py"
    file.write_text(file.read_text().replace("npdr_code_neighbour", f"{module}.plant"))
    before = code_checksum(load_function(file, "own"))
    assert checksum_after(folder, f"{module}/plant.py", "__init__", "reset") != before
    assert checksum_after(folder, f"{module}/template.py", "name", "title") != before


def test_modules_of_the_models_own_package_count(folder):
    package = folder / "npdr_code_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "physics.py").write_text(NEIGHBOUR)
    text = (folder / "own.py").read_text()
    text = text.replace("npdr_code_neighbour", "npdr_code_package.physics")
    (package / "model.py").write_text(text)
    sys.path.insert(0, str(folder))
    before = code_checksum(load_function(package / "model.py", "own"))
    file = package / "physics.py"
    file.write_text(file.read_text().replace("__init__", "reset"))
    assert code_checksum(load_function(package / "model.py", "own")) != before


def test_the_checksum_is_the_same_in_every_process(folder):
    for number in range(4):
        (folder / f"npdr_code_{number}.py").write_text(f"VALUE = {number}\n")
    imports = "\n".join(f"import npdr_code_{number}" for number in range(4))
    uses = ", ".join(f"npdr_code_{number}.VALUE" for number in range(4))
    file = folder / "many.py"
    file.write_text(
        f"{imports}\n\n\ndef own(inputs):\n    import npdr_code_neighbour\n    {uses}\n"
    )
    program = (
        "import sys; from pathlib import Path; from npdr_ppl.cli.model_files import load_function;"
        "from npdr_ppl.model_code import code_checksum;"
        "print(code_checksum(load_function(Path(sys.argv[1]), 'own')))"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", program, str(file)],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(found) == 1


MADE = """
import functools

from npdr_code_neighbour import Plant


class Model:
    def __init__(self, scale):
        self.scale = scale

    def __call__(self, inputs):
        return self.scale


def make(scale):
    def model(inputs):
        return scale
    return model


def logged(function):
    @functools.wraps(function)
    def inner(*args):
        return function(*args)
    return inner


@logged
def decorated(inputs):
    return 2.0


made = make(2.0)
instance = Model(2.0)
part = functools.partial(Model(1.0), inputs=2.0)
"""


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("made", "make(2.0)", "make(3.0)"),
        ("instance", "= Model(2.0)", "= Model(3.0)"),
        ("part", "inputs=2.0", "inputs=3.0"),
        ("part", "Model(1.0)", "Model(3.0)"),
        ("decorated", "return 2.0", "return 3.0"),
        ("decorated", "function(*args)", "function(args)"),
    ],
)
def test_arguments_and_decorators_of_models_count(folder, name, old, new):
    file = folder / "made.py"
    file.write_text(MADE)
    before = code_checksum(load_function(file, name))
    file.write_text(MADE.replace(old, new))
    assert code_checksum(load_function(file, name)) != before
    file.write_text(MADE.replace("class Model", "# a comment\nclass Model"))
    assert code_checksum(load_function(file, name)) == before


EFFECT = """
from npdr_ppl.models.effects import CoulombFriction

UNUSED = 1


class Own(CoulombFriction):
    title = "own"
"""


def test_of_an_effect_its_class_counts(folder):
    def checksum(text):
        (folder / "own_effect.py").write_text(text)
        effect = load_function(folder / "own_effect.py", "Own")("hinge")
        return code_checksum(npdr.add_effect(pendulum, effect))

    before = checksum(EFFECT)
    assert checksum(EFFECT.replace('"own"', '"other"')) != before
    assert checksum(EFFECT.replace("UNUSED = 1", "# unused")) == before


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
