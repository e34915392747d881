"""The page on effects: its example runs as printed and keeps the contract."""

import re
import tomllib
from pathlib import Path

import pyro
import pytest
import torch

from npdr_ppl.cli.effect_words import named_effects
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effect_additions import add_file
from npdr_ppl.models.effects import effects
from npdr_ppl.models.pendulum import Pendulum

PAGE = Path(__file__).parents[1] / "docs" / "effects.md"


@pytest.fixture(scope="module")
def scope():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, str(PAGE), "exec"), names)
    return names


def test_the_example_is_a_model_with_the_effect(scope):
    inputs = Inputs.single(
        torch.ones(20, 1),
        torch.tensor([0.5, 0.0]),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=Pendulum.time_step,
    )
    trace = pyro.poutine.trace(scope["model"]).get_trace(inputs)
    assert trace.nodes["hinge.magnet.strength"]["value"] >= 0.0
    base = Pendulum().simulate({}, inputs)
    attached = Pendulum().with_effects(scope["Magnet"]("hinge"))
    assert torch.equal(attached.simulate({}, inputs), base)
    probe = scope["Magnet"]("hinge").probe(Pendulum().port("hinge"))
    given = {"hinge.magnet.strength": torch.tensor(probe["strength"])}
    assert not torch.equal(attached.simulate(given, inputs), base)


def test_the_class_has_about_ten_lines(scope):
    source = PAGE.read_text()
    body = source[source.index("class Magnet") : source.index("model = add_effect")]
    assert len([line for line in body.splitlines() if line.strip()]) <= 10


def test_the_entry_point_names_the_effect(scope):
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (entry,) = tomllib.loads(text)["project"]["entry-points"]["npdr_ppl.effects"].items()
    assert entry[0] == scope["Magnet"].id
    assert entry[1].endswith(":Magnet")


def test_the_example_can_be_attached_and_added(scope, tmp_path, monkeypatch):
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    file = tmp_path / "magnet.py"
    file.write_text(example)
    monkeypatch.setenv("NPDR_EFFECTS", str(tmp_path / "home"))
    (attached,) = named_effects([f"{file}:Magnet@hinge"])
    assert attached.name == "hinge.magnet"
    assert add_file(file).ids == ("magnet",)
    assert [effect.name for effect in named_effects(["hinge.magnet"])] == ["hinge.magnet"]


def test_the_readme_has_the_number_of_effects():
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    assert re.findall(r"\[(\d+): `npdr effects`\]", readme) == [str(len(effects()))]
