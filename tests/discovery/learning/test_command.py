"""`npdr discover --learn`: what it prints and writes, and that other commands accept it."""

import json
import runpy

import pytest
from hidden_rigs import make_case

from npdr_ppl.cli.effect_words import named_effects
from tests.helpers.command_line import run


@pytest.mark.slow
def test_the_command_prints_a_law_and_writes_a_file_that_commands_accept(
    tmp_path, monkeypatch, capsys
):
    place = ("hinge", "cubic_damping")
    case = make_case("pendulum", "outside", (place,), strength=3.0, seed=2001)
    for name, rollouts in (("fit", case.fit), ("chirp", case.holdout)):
        rollouts.to_csv(tmp_path / f"{name}.csv")
    folder = tmp_path / "run"
    code, text, err = run(
        monkeypatch, capsys, "discover", "pendulum", "--data", tmp_path / "fit.csv",
        "--holdout-data", tmp_path / "chirp.csv", "--max-effects", 0, "--learn", "--out", folder,
    )  # fmt: skip
    assert code == 0, err
    assert "Learned law" in text and "v³" in text and "the held-out rollouts" in text
    found = json.loads((folder / "discovery.json").read_text())
    assert found["verdict"] == "learned"
    assert max(found["learned"]["depends_on"]["hinge"].items(), key=lambda i: i[1])[0] == "v"
    assert (folder / "learned_law.png").read_bytes()[:4] == b"\x89PNG"
    word = f"{folder / 'learned_effect.py'}@hinge"
    (effect,) = named_effects([word])
    assert effect.name == "hinge.learned_hinge"
    revised = runpy.run_path(str(folder / "revised_model.py"))
    (attached,) = (each for each, _ in revised["revised_model"].effects)
    assert attached.law == effect.law
    assert revised["CLOSEST_FIT"]["hinge.learned_hinge.c1"] == pytest.approx(
        found["learned"]["laws"][0]["constants"]["c1"]["value"], rel=1e-4
    )
