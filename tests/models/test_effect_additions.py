"""Effects that a user adds: checks before, and what becomes of them after."""

import logging

import pytest

from npdr_ppl import added_files
from npdr_ppl.errors import ModelError
from npdr_ppl.models.effect_additions import add_file, check_effect, remove_file
from npdr_ppl.models.effects import added, candidate_effects, effect_class, effects
from npdr_ppl.models.pendulum import Pendulum
from tests.helpers.effect_files import CUBIC, GAIN


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of added effects, and the present folder beside it."""
    home = tmp_path / "home"
    monkeypatch.setenv("NPDR_EFFECTS", str(home))
    monkeypatch.chdir(tmp_path)
    added._warn_once.cache_clear()
    return home


def written(folder, text, name="law.py"):
    """Writes a file beside the folder of added effects; returns it."""
    file = folder.parent / name
    file.write_text(text)
    return file


def test_an_added_effect_is_a_candidate_until_it_is_removed(folder):
    before = len(candidate_effects(Pendulum()))
    addition = add_file(written(folder, CUBIC))
    assert addition.file == folder / "learned_hinge.py" and not addition.unchecked
    assert list(effects())[-1] == "learned_hinge"
    assert effect_class("learned_hinge")("hinge").name == "hinge.learned_hinge"
    assert effect_class("learned_hinge") is effects()["learned_hinge"]
    names = [effect.name for effect in candidate_effects(Pendulum())]
    assert len(names) == before + 1 and names[-1] == "hinge.learned_hinge"
    assert remove_file("learned_hinge").ids == ("learned_hinge",)
    assert "learned_hinge" not in effects() and not list(folder.iterdir())
    with pytest.raises(ModelError, match="no effect 'learned_hinge'"):
        effect_class("learned_hinge")


def test_a_file_may_have_several_effects(folder):
    assert add_file(written(folder, GAIN)).ids == ("pushed", "shifted")
    names = {effect.name for effect in candidate_effects(Pendulum())}
    assert {"torque.pushed", "angle.shifted", "velocity.shifted"} <= names
    assert remove_file("shifted").ids == ("pushed", "shifted")
    assert "pushed" not in effects()


def test_two_files_of_one_name_are_two_files(folder):
    add_file(written(folder, CUBIC))
    add_file(written(folder, CUBIC.replace("learned_hinge", "learned_other")))
    assert {"learned_hinge", "learned_other"} <= set(effects())


REFUSED = {
    "cannot be loaded: NameError": (CUBIC, "undefined\n" + CUBIC),
    "has no effect": ("(ForceEffect)", ""),
    "two effects of the id 'pushed'": (CUBIC, GAIN.replace('"shifted"', '"pushed"')),
    "`npdr effects` has an effect 'spring' already; change the id in": (
        '"learned_hinge"',
        '"spring"',
    ),
    "has no prior of cubic": ('"cubic": dist', '"cubc": dist'),
    "has a prior of other, which is no parameter": (
        'return {"cubic"',
        'return {"other": dist.Normal(0.0, 1.0), "cubic"',
    ),
    "does not define default_priors": ("def default_priors", "def other"),
    "changes the trajectory of Pendulum although .* nominal \\(cubic = 0\\)": (
        '-parameters["cubic"]',
        '-(parameters["cubic"] + 1e-14)',
    ),
    "LearnedHinge in .*law.py fails: KeyError: 'cubc'": (
        'parameters["cubic"]',
        'parameters["cubc"]',
    ),
    "works only in its own folder": (
        "POWER = 3",
        'from pathlib import Path\nPOWER = int((Path(__file__).parent / "power.txt").read_text())',
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_bad_file_is_refused(folder, message):
    (folder.parent / "power.txt").write_text("3")
    file = written(folder, CUBIC.replace(*REFUSED[message]))
    with pytest.raises(ModelError, match=message):
        add_file(file)
    assert not folder.exists() or not list(folder.iterdir())


def test_an_id_is_added_once(folder):
    file = written(folder, CUBIC)
    add_file(file)
    with pytest.raises(ModelError, match="already, .*learned_hinge.py; remove it with"):
        add_file(file)


def test_a_broken_file_costs_its_effect_only(folder, caplog):
    add_file(written(folder, GAIN))
    (folder / "broken.py").write_text("import no_such_module\n")
    (folder / "ends.py").write_text("raise SystemExit(1)\n")
    (folder / "taken.py").write_text(CUBIC.replace('"learned_hinge"', '"pushed"'))
    (folder / "reserved.py").write_text(CUBIC.replace('"learned_hinge"', '"bias"'))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            found = effects()
    assert {"pushed", "shifted", "bias"} <= set(found)
    assert found["bias"].__module__.startswith("npdr_ppl.")
    assert len(caplog.messages) == 4, "one warning for each file"
    assert str(folder / "broken.py") in caplog.text and "--remove broken.py" in caplog.text
    assert remove_file("broken.py").ids == ()


def test_wrong_ids_are_not_removed(folder):
    add_file(written(folder, CUBIC))
    with pytest.raises(ModelError, match="did you mean 'learned_hinge'"):
        remove_file("lerned_hinge")
    with pytest.raises(ModelError, match="'bias' is not an effect that you added"):
        remove_file("bias")


@pytest.mark.parametrize("name", effects())
def test_the_catalogue_passes_the_check(name, tmp_path):
    is_checked = check_effect(effects()[name], tmp_path)
    assert is_checked or name == "contact", "no model has coefficients of contacts"


def test_the_folder_is_that_of_the_users_data(monkeypatch, tmp_path):
    monkeypatch.delenv("NPDR_EFFECTS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert added_files.added_folder() == tmp_path / "npdr_ppl" / "effects"
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert added_files.added_folder().is_relative_to(tmp_path)


def test_ids_are_read_without_running_a_file(tmp_path):
    file = tmp_path / "law.py"
    file.write_text("raise SystemExit\n" + CUBIC + "class A:\n    id: str = 'a'\n")
    assert added_files.declared_ids(file) == ["learned_hinge", "a"]
    file.write_text("x =")
    assert added_files.declared_ids(file) == []
