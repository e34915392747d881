"""A revised model with effects of a user's files needs none of these files."""

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.cli.effect_words import named_effects
from npdr_ppl.cli.model_files import load_function
from npdr_ppl.discovery.revised_model import revised_source
from npdr_ppl.language.layers import layers
from npdr_ppl.model_identity import source_text
from npdr_ppl.models.effects import Bias
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.effect_files import CUBIC, GAIN

# A text of two lines, whose length is the power, must keep its lines.
CUBIC_5 = CUBIC.replace("POWER = 3", 'POWER = len("""a\n  b""")')
CUBIC_5 = CUBIC_5.replace('"learned_hinge"', '"learned_other"')

OWN_MODEL = """
import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum


class Bias:
    slope = 0.5


def hat(mass):
    return mass * 2.0 * Bias.slope


def own(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    return npdr.simulate("trajectory", Pendulum(), {"mass": hat(mass)}, inputs, noise=0.1)
"""


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Writes files to a folder that is gone when the revised model is read."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sources").mkdir()

    def write(name, text):
        (tmp_path / "sources" / name).write_text(text)
        return f"sources/{name}"

    return write


def read_back(tmp_path, source, name="revised.py"):
    """Returns the revised model after the files that it came from were removed."""
    for file in (tmp_path / "sources").iterdir():
        file.unlink()
    path = tmp_path / name
    path.write_text(source)
    assert "_npdr_" not in source, "no module that only this process knows"
    return load_function(path, "revised_model")


def attached(model):
    """Returns the effects of a model by name."""
    return {e.name: e for layer in layers(model)[1:] for e, _ in layer.effects}


def force(effect, velocity=2.0):
    parameters = {"cubic": torch.ones(1)}
    return effect.force(torch.zeros(1), torch.tensor([velocity]), parameters, None).item()


def test_found_and_attached_effects_are_written_into_the_file(written, tmp_path):
    (cubic,) = named_effects([f"{written('cubic.py', CUBIC)}@hinge"])
    (shifted,) = named_effects([f"{written('gain.py', GAIN)}:Shifted@angle,velocity"])
    source = revised_source(
        npdr.add_effect(pendulum, cubic), (shifted, Bias("hinge")), {"mass": 1.0}
    )
    assert "Pushed" not in source and "sources" not in source
    assert '    """−c v³: damping that grows with the cube of the speed."""\n' in source
    found = attached(read_back(tmp_path, source))
    assert list(found) == ["hinge.learned_hinge", "angle,velocity.shifted", "hinge.bias"]
    assert force(found["hinge.learned_hinge"]) == -8.0
    # Both files have a function of this name.
    (read, _) = found["angle,velocity.shifted"].read(2.0, {"shift": 1.0}, None, 0.1)
    assert read == 3.0


def test_files_with_the_same_names_stay_apart(written, tmp_path):
    effects = named_effects(
        [f"{written('a.py', CUBIC)}@hinge", f"{written('b.py', CUBIC_5)}@hinge"]
    )
    found = attached(read_back(tmp_path, revised_source(pendulum, tuple(effects), {})))
    assert {name: force(e) for name, e in found.items()} == {
        "hinge.learned_hinge": -8.0,
        "hinge.learned_other": -32.0,
    }


def test_a_model_file_keeps_its_own_names(written, tmp_path):
    model = load_function(tmp_path / written("own.py", OWN_MODEL), "own")
    (cubic,) = named_effects([f"{written('cubic.py', CUBIC)}@hinge"])
    source = revised_source(model, (cubic, Bias("hinge")), {})
    revised = read_back(tmp_path, source)
    found = attached(revised)
    assert force(found["hinge.learned_hinge"]) == -8.0
    assert type(found["hinge.bias"]) is Bias
    scope = layers(revised)[0].__globals__
    assert scope["hat"](3.0) == 3.0 and scope["Bias"].slope == 0.5


def test_a_model_and_its_effect_may_be_in_one_file(written, tmp_path):
    text = OWN_MODEL + CUBIC.replace("hat", "power").partition('"""\n')[2]
    text += '\n\nmodel = npdr.add_effect(own, LearnedHinge("hinge"))\n'
    model = load_function(tmp_path / written("both.py", text), "model")
    source = revised_source(model, (Bias("hinge"),), {})
    assert source.count("class LearnedHinge") == 1
    found = attached(read_back(tmp_path, source))
    assert list(found) == ["hinge.learned_hinge", "hinge.bias"]


def test_a_revised_model_can_be_revised_again(written, tmp_path):
    effects = named_effects(
        [f"{written('a.py', CUBIC)}@hinge", f"{written('b.py', CUBIC_5)}@hinge"]
    )
    first = read_back(tmp_path, revised_source(pendulum, tuple(effects), {"mass": 1.0}))
    source = revised_source(first, (Bias("hinge"),), {"mass": 2.0})
    assert source.count("CLOSEST_FIT = ") == 1 and source.count("revised_model = pendulum") == 1
    (tmp_path / "revised.py").unlink()
    found = attached(read_back(tmp_path, source, "again.py"))
    assert list(found) == ["hinge.learned_hinge", "hinge.learned_other", "hinge.bias"]
    assert force(found["hinge.learned_other"]) == -32.0


def test_imports_from_the_future_come_first(written, tmp_path):
    text = CUBIC.replace(
        "from collections", "from __future__ import annotations\n\nfrom collections"
    )
    text = text.replace("value: Tensor", "value: NotImported")
    (cubic,) = named_effects([f"{written('cubic.py', text)}@hinge"])
    source = revised_source(pendulum, (cubic,), {})
    assert source.startswith('"""pendulum with the effects that it was missing."""\n\nfrom __fut')
    assert list(attached(read_back(tmp_path, source))) == ["hinge.learned_hinge"]


def test_priors_that_were_given_are_kept(written, tmp_path):
    from pyro.distributions import LogNormal

    (cubic,) = named_effects([f"{written('cubic.py', CUBIC)}@hinge"])
    given = type(cubic)("hinge", priors={"cubic": LogNormal(-3.0, 0.1)})
    (found,) = attached(read_back(tmp_path, revised_source(pendulum, (given,), {}))).values()
    assert isinstance(found.given_priors["cubic"], LogNormal)


def test_a_run_depends_on_the_law_of_an_effect_in_a_file(written):
    path = written("cubic.py", CUBIC)
    texts = []
    for text in (CUBIC, CUBIC_5):
        written("cubic.py", text)
        texts.append(source_text(npdr.add_effect(pendulum, named_effects([f"{path}@hinge"])[0])))
    assert texts[0] != texts[1]
    assert "def hat" in texts[0]
