"""Reading the terms of Isaac Lab from its source, and comparing a configuration with them."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from isaac_lab import Signature, faults, signatures, terms

from tests.helpers.isaac_lab_stub import REQUIRED, TERMS

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "isaac_lab.py"

SOURCE = '''
def randomize_centre(env, env_ids, com_range, asset_cfg):
    """A function."""

class randomize_mass:
    def __init__(self, cfg, env):
        """Not the one that is compared."""

    def __call__(self, env, env_ids, asset_cfg, mass, operation, distribution="uniform"):
        """A class."""

class Helper:
    pass
'''

CONFIGURATION = """
@configclass
class EventCfg:
    hand = EventTerm(
        func=mdp.randomize_mass,
        mode="startup",
        params={"asset_cfg": SceneEntityCfg("robot"), "mass": (1, 2), "operation": "abs"},
    )
"""


def test_arguments_are_those_behind_the_environment():
    assert signatures(SOURCE) == {
        "randomize_centre": Signature(("com_range", "asset_cfg"), ()),
        "randomize_mass": Signature(("asset_cfg", "mass", "operation"), ("distribution",)),
    }


def test_terms_of_a_configuration_are_read():
    assert terms(CONFIGURATION) == {"hand": ("randomize_mass", ["asset_cfg", "mass", "operation"])}


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("randomize_mass", "randomize_weight", "hand: there is no randomize_weight"),
        ('"mass": (1, 2), ', "", "hand: randomize_mass needs mass"),
        ('"operation"', '"op": 1, "operation"', "hand: randomize_mass has no op"),
        ("hand", "hand", None),
    ],
)
def test_a_term_that_isaac_lab_would_refuse_is_named(old, new, fault):
    found = faults(CONFIGURATION.replace(old, new), signatures(SOURCE))
    assert found == ([] if fault is None else [fault])


def test_a_wheel_is_read_without_running_it(tmp_path):
    wheel = tmp_path / "isaaclab-9.0.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("isaaclab/envs/mdp/events.py", SOURCE + "\nraise SystemExit(3)\n")
        archive.writestr("isaaclab_tasks/lift/mdp/events.py", "")
    (tmp_path / "events.py").write_text(CONFIGURATION)
    command = [sys.executable, str(SCRIPT), str(tmp_path / "events.py"), str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{wheel.name}: 1 terms, 0 faults\n"


def test_the_stand_in_requires_an_operation_of_every_term_that_takes_one():
    for name, arguments in TERMS.items():
        assert arguments.get("operation", REQUIRED) is REQUIRED, name


def test_a_file_without_terms_is_no_success(tmp_path):
    (tmp_path / "events.py").write_text("ranges = {}\n")
    (tmp_path / "terms.py").write_text(SOURCE)
    command = [
        sys.executable,
        str(SCRIPT),
        str(tmp_path / "events.py"),
        str(tmp_path / "terms.py"),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and "has no terms of events" in done.stderr
