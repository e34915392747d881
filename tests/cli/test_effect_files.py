"""Effects of a user's own Python file: --effect path/to/file.py:Class@port."""

import json
import sys

import cloudpickle
import pytest
import torch

from npdr_ppl.cli.effect_words import named_effects, split_effects
from npdr_ppl.cli.model_files import load_function
from npdr_ppl.cli.names import complete_effect
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ForceEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.layers import layers
from npdr_ppl.models.effects import effects
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.python_files import class_file, load_python_file
from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import run
from tests.helpers.effect_files import CUBIC, GAIN
from tests.helpers.pendulum_recordings import swinging


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The present folder, with two files of effects."""
    (tmp_path / "cubic.py").write_text(CUBIC)
    (tmp_path / "gain.py").write_text(GAIN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("hinge.bias", ["hinge.bias"]),
        ("a,b.bias, hinge.bias", ["a,b.bias", "hinge.bias"]),
        ("cubic.py:LearnedHinge@hinge", ["cubic.py:LearnedHinge@hinge"]),
        ("cubic.py@a,b", ["cubic.py@a,b"]),
        ("cubic.py@a,b,hinge.bias", ["cubic.py@a,b", "hinge.bias"]),
        ("a,b.bias,my/x.py:C@c,d,../y.py@e", ["a,b.bias", "my/x.py:C@c,d", "../y.py@e"]),
        ("C:\\rigs\\x.py:C@hinge", ["C:\\rigs\\x.py:C@hinge"]),
        ("cubic.py:LearnedHinge", ["cubic.py:LearnedHinge"]),
    ],
)
def test_words_are_split_where_an_effect_ends(text, parts):
    assert split_effects(text, effects()) == parts


@pytest.mark.usefixtures("folder")
def test_effects_of_files_stand_beside_those_of_the_catalogue():
    found = named_effects(["cubic.py@hinge,hinge.bias", "gain.py:Shifted@angle,velocity"])
    assert [e.name for e in found] == [
        "hinge.learned_hinge", "hinge.bias", "angle,velocity.shifted"
    ]  # fmt: skip


MESSAGES = {
    "cubc.py:LearnedHinge@hinge": "Did you mean cubic.py:LearnedHinge@hinge?",
    "cubic.py:LearndHinge@hinge": "no class 'LearndHinge'; did you mean cubic.py:LearnedHinge?",
    "cubic.py:hat@hinge": "cubic.py:hat is no effect",
    "cubic.py:LearnedHinge": "port of kind force: write cubic.py:LearnedHinge@PORT.",
    "cubic.py": "port of kind force: write cubic.py:LearnedHinge@PORT.",
    "gain.py@torque": "has the effects Pushed, Shifted; say which, as in gain.py:Pushed@PORT.",
    "empty.py@hinge": "empty.py has no effect",
    "broken.py@hinge": "broken.py cannot be loaded: NameError: name 'undefined' is not defined.",
    "ends.py@hinge": "ends.py cannot be loaded: SystemExit: 3.",
    "nameless.py@hinge": "Nameless in nameless.py does not define id",
    "half.py@hinge": "Half in half.py does not define default_priors",
    "dotted.py@hinge": "has the id 'a.b'; it may have letters, digits and underscores only,",
    "hidden.py@hinge": "has the id '_law'; it may have letters, digits and underscores only, and",
    "taken.py@hinge": "has the id 'spring' of another effect of `npdr effects`; change the id",
    "hinge.baias": "did you mean 'bias'?",
}


@pytest.fixture
def wrong_files(folder):
    """Files that are no good."""
    (folder / "empty.py").write_text("X = 1\n")
    (folder / "broken.py").write_text("undefined\n")
    (folder / "ends.py").write_text("import sys\nsys.exit(3)\n")
    (folder / "nameless.py").write_text(
        CUBIC.replace('    id = "learned_hinge"\n', "").replace("LearnedHinge", "Nameless")
    )
    half = CUBIC.replace("default_priors", "other").replace("LearnedHinge", "Half")
    (folder / "half.py").write_text(half)
    (folder / "taken.py").write_text(CUBIC.replace('"learned_hinge"', '"spring"'))
    (folder / "hidden.py").write_text(CUBIC.replace('"learned_hinge"', '"_law"'))
    (folder / "dotted.py").write_text(CUBIC.replace('"learned_hinge"', '"a.b"'))


@pytest.mark.usefixtures("wrong_files")
@pytest.mark.parametrize("word", MESSAGES)
def test_a_wrong_word_gets_one_sentence(word):
    with pytest.raises(ModelError) as raised:
        named_effects([word])
    assert MESSAGES[word] in str(raised.value)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("cubic.py@hing", "no port 'hing'; did you mean 'hinge'?"),
        ("cubic.py@torque", "learned_hinge attaches to a port of kind force"),
        ("cubic.py", "write cubic.py:LearnedHinge@PORT."),
    ],
)
@pytest.mark.parametrize("command", ["fit", "compare", "discover"])
def test_commands_refuse_a_wrong_port(word, message, command, folder, monkeypatch, capsys):
    swinging(rollouts=2).to_csv(folder / "data.csv")
    words = [command, "pendulum", "--data", "data.csv", "--out", "out", "--effect", word]
    words += ["--backends", "snpe-c,abc"] * (command == "compare")
    code, _, err = run(monkeypatch, capsys, *words, "--quiet")
    assert code == 2 and err.startswith("npdr: ") and err.count("\n") == 1
    assert message in err


@pytest.mark.usefixtures("folder")
def test_workers_get_the_classes_as_code(monkeypatch):
    (effect,) = named_effects(["cubic.py@hinge"])
    sent = cloudpickle.dumps(effect)
    # As in a worker, which has no module of this name.
    monkeypatch.delitem(sys.modules, type(effect).__module__)
    received = cloudpickle.loads(sent)
    assert isinstance(received, ForceEffect) and received.name == "hinge.learned_hinge"
    force = received.force(torch.zeros(1), torch.tensor([2.0]), {"cubic": torch.ones(1)}, None)
    assert force.item() == -8.0
    assert class_file(type(received)).name == "cubic.py"


def test_files_of_the_same_name_do_not_collide(tmp_path):
    for name, power in (("a", 3), ("b", 5)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "law.py").write_text(CUBIC.replace("POWER = 3", f"POWER = {power}"))
    first, second = (
        named_effects([f"{tmp_path}/{name}/law.py@hinge"])[0] for name in ("a", "b")
    )  # fmt: skip
    values = torch.zeros(1), torch.tensor([2.0]), {"cubic": torch.ones(1)}, None
    for effect, force in ((first, -8.0), (second, -32.0)):
        assert effect.force(*values).item() == force
        assert cloudpickle.loads(cloudpickle.dumps(effect)).force(*values).item() == force


def test_the_file_of_a_class_is_found_without_a_function_and_behind_a_decorator(tmp_path):
    file = tmp_path / "law.py"
    decorated = CUBIC.replace("    def force(", "    @torch.no_grad()\n    def force(")
    soft = 'class Soft(LearnedHinge):\n    id = "soft"\n'
    file.write_text(f"{decorated.replace('POWER = 3', 'import torch')}\n\n{soft}")
    module = load_python_file(file)
    for cls in (module.LearnedHinge, module.Soft):
        assert class_file(cls) == file


def test_a_file_is_loaded_again_only_if_it_changed(tmp_path):
    file = tmp_path / "json.py"
    file.write_text(CUBIC)
    module = load_python_file(file)
    assert load_python_file(file) is module
    assert sys.modules["json"] is json
    # Of the same length and within the same second.
    file.write_text(CUBIC.replace("POWER = 3", "POWER = 5"))
    assert load_python_file(file).POWER == 5


@pytest.mark.slow
def test_a_fit_with_an_effect_of_a_file(folder, monkeypatch, capsys):
    swinging(rollouts=2, steps=100).to_csv(folder / "data.csv")
    code, _, err = run(
        monkeypatch, capsys, "fit", "pendulum", "--data", "data.csv", "--out", "out",
        "--effect", "cubic.py@hinge", "--rounds", 1, "--simulations", 100, "--embedding", "all/5",
        "--quiet",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads((folder / "out" / "fit.json").read_text())["parameters"]
    assert set(found) == {"mass", "length", "hinge.learned_hinge.cubic"}


@pytest.fixture
def home(folder, monkeypatch):
    """An empty folder of added effects."""
    monkeypatch.setenv("NPDR_EFFECTS", str(folder / "home"))
    return folder / "home"


def test_npdr_effects_adds_lists_and_removes(home, monkeypatch, capsys):
    code, text, _ = run(monkeypatch, capsys, "effects", "--add", "cubic.py")
    assert code == 0
    assert text.startswith(f"Added learned_hinge: {home / 'learned_hinge.py'}\n")
    _, text, _ = run(monkeypatch, capsys, "effects", "--json")
    rows = json.loads(text)
    assert [row["name"] for row in rows if "file" in row] == ["learned_hinge"]
    assert rows[-1]["file"] == str(home / "learned_hinge.py")
    _, text, _ = run(monkeypatch, capsys, "effects")
    assert str(home) in "".join(text.split("learned_hinge\n")[1].split())
    assert [e.name for e in named_effects(["hinge.learned_hinge"])] == ["hinge.learned_hinge"]
    assert [e.name for e in named_effects(["cubic.py@hinge"])] == ["hinge.learned_hinge"]
    assert complete_effect("hinge.lear") == ["hinge.learned_hinge"]
    code, text, _ = run(monkeypatch, capsys, "effects", "--remove", "learned_hinge", "--json")
    assert code == 0 and json.loads(text)["removed"] == ["learned_hinge"]
    code, _, err = run(monkeypatch, capsys, "effects", "--remove", "learned_hinge")
    assert code == 2 and err.startswith("npdr: You have added no effect")


@pytest.mark.usefixtures("home")
def test_npdr_effects_does_one_thing_at_a_time(monkeypatch, capsys):
    for words in (("bias", "--add", "cubic.py"), ("--add", "cubic.py", "--remove", "bias")):
        code, _, err = run(monkeypatch, capsys, "effects", *words)
        assert code == 2 and "takes one of a name, --add and --remove" in err


@pytest.fixture
def damped(folder):
    """Rollouts of a pendulum with cubic damping, ``damped.csv``."""
    (cubic,) = named_effects(["cubic.py@hinge"])
    generator = torch.Generator().manual_seed(0)
    time = Pendulum.time_step * torch.arange(250, dtype=torch.float64)
    truth = {"mass": 1.1, "length": 0.9, "hinge.learned_hinge.cubic": 0.02}
    readings, actions = [], []
    for k in range(2):
        rates = torch.tensor([0.3, 0.8, 1.3]) + 0.13 * k
        torque = 1.25 * torch.sin(2.0 * torch.pi * rates[:, None] * time + k).sum(0)
        state = torch.tensor([0.4 * k, 0.0], dtype=torch.float64)
        inputs = Inputs.single(
            torque[:, None], state, action_names=("torque",),
            state_names=("angle", "velocity"), time_step=Pendulum.time_step,
        )  # fmt: skip
        rig = Pendulum().with_effects(cubic)
        given = {name: torch.tensor(v, dtype=torch.float64) for name, v in truth.items()}
        exact = torch.cat([state[None], rig.simulate(given, inputs).reshape(-1, 2)])
        noise = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        readings.append((exact + noise * torch.tensor([0.002, 0.01])).numpy())
        actions.append(torque[:, None].numpy())
    Rollouts.from_arrays(
        readings, actions, channel_names=("angle", "velocity"), action_names=("torque",),
        time_step=Pendulum.time_step,
    ).to_csv(folder / "damped.csv")  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("damped")
def test_a_search_finds_the_effect_of_a_file(folder, monkeypatch, capsys):
    code, _, err = run(
        monkeypatch, capsys, "discover", "pendulum", "--data", "damped.csv", "--out", "out",
        "--candidates", "hinge.bias,cubic.py:LearnedHinge@hinge,hinge.coulomb_friction",
        "--executor", "loky", "--workers", 2, "--quiet",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads((folder / "out" / "discovery.json").read_text())
    assert [(e["port"], e["effect"]) for e in found["effects"]] == [("hinge", "learned_hinge")]
    assert found["parameters"]["hinge.learned_hinge.cubic"]["mean"] == pytest.approx(0.02, rel=0.2)
    (folder / "cubic.py").unlink()
    revised = load_function(folder / "out" / "revised_model.py", "revised_model")
    assert [effect.name for effect, _ in layers(revised)[1].effects] == ["hinge.learned_hinge"]
