"""`npdr export`: a run's values in the robot's own file."""

import json
import runpy

import mujoco
import pytest

from tests.cli.test_robot_files import write_arm
from tests.helpers.command_line import run_for_module
from tests.helpers.effect_files import DAMPING


def write_fit(folder, parameters):
    """A finished fit, of which only the parameters matter here."""
    folder.mkdir()
    intervals = {n: {"mean": v, "sd": 0.1, "hdi_94": [0.0, 1.0]} for n, v in parameters.items()}
    found = {"backend": "snpe-c", "parameters": intervals, "finer_steps": 0}
    (folder / "fit.json").write_text(json.dumps(found))
    return folder


MODEL = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr

arm = npdr.MujocoSimulator("arm.xml", {"kp": "actuator servo kp"})

def model(inputs):
    return npdr.simulate("x", arm, {"kp": pyro.sample("kp", dist.Uniform(20.0, 30.0))}, inputs)
"""


@pytest.fixture
def fitted(tmp_path):
    """A robot's file, a model file beside it, and a fit with an effect."""
    write_arm(tmp_path)
    (tmp_path / "arm_model.py").write_text(MODEL)
    values = {"kp": 44.0, "shoulder_torque.coulomb_friction.magnitude": 0.25}
    return tmp_path, write_fit(tmp_path / "fit", values)


def test_values_of_a_fit_are_in_the_file_beside_the_old_ones(fitted):
    folder, fit = fitted
    to = folder / "identified.xml"
    code, text, err = run_for_module("export", fit, f"{folder / 'arm_model.py'}:model", "--to", to)
    assert code == 0, err
    assert "+++ identified.xml" in text and "kp 44 (was 40)" in text
    found = mujoco.MjModel.from_xml_path(str(to))
    assert found.actuator("servo").gainprm[0] == 44.0  # outside of its prior, as after widening
    assert found.joint("shoulder").frictionloss[0] == 0.25
    assert (
        mujoco.MjModel.from_xml_path(str(folder / "arm.xml")).joint("shoulder").frictionloss == 0
    )


@pytest.mark.parametrize("verdict", ["named", "ambiguous", "unknown"])
def test_a_verdict_that_names_no_effect_is_said(fitted, verdict):
    folder, _ = fitted
    run = folder / verdict
    run.mkdir()
    parameters = {"kp": {"mean": 44.0, "sd": 0.1, "hdi_94": [0.0, 1.0]}}
    found = {"verdict": verdict, "reason": "Because.", "parameters": parameters, "finer_steps": 0}
    (run / "discovery.json").write_text(json.dumps(found))
    words = "export", run, f"{folder / 'arm_model.py'}:model", "--to", run / "new.xml"
    code, text, err = run_for_module(*words)
    assert code == 0, err
    assert (f"is {verdict}: Because." in text) == (verdict != "named")


def test_what_mujoco_does_not_have_is_a_python_file_beside_the_robots(fitted):
    folder, _ = fitted
    values = {"kp": 44.0, "elbow.encoder_bias.offset": 0.01, "kp.parameter_drift.rate": 0.001}
    fit = write_fit(folder / "other", values)
    words = "export", fit, f"{folder / 'arm_model.py'}:model", "--to", folder / "my-arm.xml"
    code, text, err = run_for_module(*words, "--json")
    assert code == 0, err
    told = json.loads(text)
    assert told["callbacks"] == str(folder / "my_arm_effects.py")
    assert told["in_callbacks"] == ["elbow.encoder_bias"]
    assert "over minutes" in told["left_out"]["kp.parameter_drift"]
    scope = runpy.run_path(told["callbacks"])
    model = mujoco.MjModel.from_xml_path(told["file"])
    measured = scope["Effects"](model).reset(mujoco.MjData(model))
    assert measured["elbow"] == 0.01 and measured["shoulder"] == 0.0
    (folder / "my-arm.xml").unlink()
    code, _, err = run_for_module(*words)
    assert code == 2 and "my_arm_effects.py exists already" in err


def test_the_ripples_of_a_discovery_are_kept(fitted):
    folder, _ = fitted
    run = folder / "discovery"
    run.mkdir()
    cogging = {"effect": "cogging", "port": "elbow_torque", "constants": {"order": 7}}
    means = {"kp": 41.0, "elbow_torque.cogging.sine": 0.3, "elbow_torque.cogging.cosine": 0.1}
    found = {
        "verdict": "named",
        "parameters": {name: {"mean": mean, "sd": 0.1} for name, mean in means.items()},
        "effects": [cogging],
    }
    (run / "discovery.json").write_text(json.dumps(found))
    words = "export", run, f"{folder / 'arm_model.py'}:model", "--to", folder / "new.xml"
    code, text, err = run_for_module(*words)
    assert code == 0, err
    assert "new_effects.py adds them" in text
    assert "order=7," in (folder / "new_effects.py").read_text()


def test_a_discovery_is_exported_with_its_effects(fitted):
    folder, _ = fitted
    run_folder = folder / "discovery"
    run_folder.mkdir()
    parameters = {
        "kp": {"mean": 41.0, "sd": 1.0},
        "shoulder_torque.viscous_friction.damping": {"mean": 0.3, "sd": 0.1},
    }
    found = {"stage": "prove", "verdict": "named", "parameters": parameters, "finer_steps": 1}
    (run_folder / "discovery.json").write_text(json.dumps(found))
    to = folder / "new.xml"
    model = f"{folder / 'arm_model.py'}:model"
    code, _, err = run_for_module("export", run_folder, model, "--to", to, "--quiet")
    assert code == 0, err
    loaded = mujoco.MjModel.from_xml_path(str(to))
    assert loaded.joint("shoulder").damping[0] == 0.3
    assert loaded.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("fit", "arm_model.py:model", "--to", "arm.xml"), "arm.xml exists already"),
        (("fit", "arm_model.py:model", "--to", "arm.urdf"), "not made from a URDF file"),
        (("parts", "arm_model.py:model", "--to", "new.xml"), "no folder of a finished"),
        (
            ("own", "arm_model.py:model", "--to", "new.xml"),
            "--effect learned_effect.py:Class@port",
        ),
        (("other", "arm_model.py:model", "--to", "new.xml"), "give the model of the run"),
        (("fit", "pendulum", "--to", "new.xml"), "has no port 'shoulder_torque'"),
    ],
)
def test_bad_input_gives_one_sentence(fitted, monkeypatch, words, sentence):
    folder, _ = fitted
    monkeypatch.chdir(folder)
    write_fit(folder / "other", {"mass": 1.0})
    write_fit(folder / "own", {"kp": 44.0, "elbow_torque.learned_by_nobody.cubic": 0.1})
    code, _, err = run_for_module("export", *words)
    assert code == 2 and err.count("\n") == 1 and sentence in err


OWN_EFFECTS = f'''{DAMPING}

class Reporting(CubicDamping):
    """A law that cannot be followed."""

    id = "reporting"

    def force(self, position, velocity, parameters, memory):
        return -parameters["damping"] * float(velocity)
'''


@pytest.fixture
def with_own_effect(fitted):
    """The folder with a file of two effects, and a run for each."""
    folder, _ = fitted
    (folder / "own.py").write_text(OWN_EFFECTS)
    for name in ("cubic_damping", "reporting"):
        site = f"shoulder_torque.{name}.damping"
        write_fit(folder / name, {"kp": 44.0, site: 0.3})
    return folder


def test_the_law_of_an_own_file_is_written_as_numpy(with_own_effect, monkeypatch):
    folder = with_own_effect
    monkeypatch.chdir(folder)
    own = ("--effect", "own.py:CubicDamping@shoulder_torque")
    words = ("cubic_damping", "arm_model.py:model", "--to", "new.xml", *own)
    code, text, err = run_for_module("export", *words)
    assert code == 0, err
    assert "not written" not in text
    effects = runpy.run_path(str(folder / "new_effects.py"))
    (law,) = effects["laws"](effects["VALUES"])
    joint = effects["Joint"](position=0.1, velocity=2.0, time=0.0, step=0.001)
    assert law.applied_force(joint) == pytest.approx(-0.3 * 8.0)
    assert "torch" not in (folder / "new_effects.py").read_text()


def test_an_own_law_that_cannot_be_followed_is_refused_by_name(with_own_effect, monkeypatch):
    folder = with_own_effect
    monkeypatch.chdir(folder)
    own = ("--effect", "own.py:Reporting@shoulder_torque")
    words = ("reporting", "arm_model.py:model", "--to", "new.xml", *own)
    code, text, err = run_for_module("export", *words)
    assert code == 0, err
    assert "not written: shoulder_torque.reporting, because its law cannot be followed" in text
    assert not (folder / "new_effects.py").exists()
