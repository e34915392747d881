"""The causes of a run with a learned law, whose file is among the added effects or not."""

import json

import pytest

from npdr_ppl.discovery.proof.surviving_causes import VERSION
from npdr_ppl.errors import DataError
from npdr_ppl.models.effect_additions import add_file
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.planning.causes import causes_of_run
from tests.helpers.effect_files import CUBIC


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A folder of a search that learned the law of ``CUBIC``; no effect is added yet."""
    monkeypatch.setenv("NPDR_EFFECTS", str(tmp_path / "added"))
    folder = tmp_path / "run"
    folder.mkdir()
    cause = {
        "effects": [{"effect": "learned_hinge", "port": "hinge", "constants": {}}],
        "probability": 1.0,
        "parameters": {"mass": 1.0, "length": 1.0, "hinge.learned_hinge.cubic": 0.01},
        "coordinates": [0.0] * 3,
        "precision": [[float(i == j) for j in range(3)] for i in range(3)],
    }
    kept = {
        "version": VERSION,
        "causes": [cause],
        "separations": [[0.0]],
        "noise": {},
        "independent_share": 1.0,
        "segment_length": 20,
        "time_step": 0.02,
        "seconds": 5.0,
        "actions": {},
        "channels": {},
    }
    law = {"port": "hinge", "effect": "learned_hinge", "formula": "−c v³"}
    found = {"verdict": "learned", "learned": {"laws": [law]}, "surviving_causes": kept}
    (folder / "discovery.json").write_text(json.dumps(found))
    (folder / "learned_effect.py").write_text(CUBIC)
    return folder


def test_a_learned_law_is_a_cause_once_its_file_is_added(run):
    with pytest.raises(DataError, match="npdr effects --add .*learned_effect.py"):
        causes_of_run(run, pendulum)
    add_file(run / "learned_effect.py")
    (cause,) = causes_of_run(run, pendulum).causes
    assert cause.name == "hinge.learned_hinge"


def test_another_law_of_the_same_port_is_not_taken_for_it(run, tmp_path):
    other = tmp_path / "other.py"
    other.write_text(
        CUBIC.replace('law = "−c v³"', 'law = "−c v⁵"').replace("POWER = 3", "POWER = 5")
    )
    add_file(other)
    with pytest.raises(DataError, match="learned the law −c v³, but .* has another, −c v⁵"):
        causes_of_run(run, pendulum)
