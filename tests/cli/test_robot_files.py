"""`npdr fit robot.xml` and `npdr inspect robot.xml`: nothing but a robot's file and a log."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import run

ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{step}" integrator="{integrator}"/>
  <include file="parts/links.xml"/>
  <actuator><position name="servo" joint="shoulder" kp="{kp}" kv="2" ctrlrange="-2 2"/></actuator>
</mujoco>
"""

LINKS = """
<mujocoinclude>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="{damping}"/>
        <geom type="sphere" pos="0 0 -0.2" size="0.03" mass="0.3"/>
      </body>
    </body>
  </worldbody>
</mujocoinclude>
"""

NOISE = 5e-4
"""Standard deviation of the encoders, in rad."""


def write_arm(folder, *, step=0.004, integrator="implicitfast", kp=40.0, damping=0.02):
    """Writes the arm's two files; returns the path of the first one."""
    (folder / "parts").mkdir(parents=True, exist_ok=True)
    (folder / "parts" / "links.xml").write_text(LINKS.format(damping=damping))
    path = folder / "arm.xml"
    path.write_text(ARM.format(step=step, integrator=integrator, kp=kp))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A robot's file, and a recording of an arm with other gains that takes other steps."""
    folder = tmp_path_factory.mktemp("robot")
    write_arm(folder)
    hidden = write_arm(folder / "hidden", step=0.001, integrator="RK4", kp=46.0, damping=0.028)
    model = mujoco.MjModel.from_xml_path(str(hidden))
    random = np.random.default_rng(0)
    data = mujoco.MjData(model)
    time = 0.01 * np.arange(200)
    command = 0.8 * np.sin(2 * np.pi * (0.6 * time + 0.25 * time**2))
    angles = [data.qpos.copy()]
    for value in command:
        data.ctrl[:] = value
        mujoco.mj_step(model, data, 10)
        angles.append(data.qpos.copy())
    Rollouts.from_arrays(
        [np.array(angles) + NOISE * random.standard_normal((201, 2))],
        [command[:, None]],
        channel_names=("shoulder", "elbow"),
        action_names=("servo",),
        time_step=0.01,
    ).to_parquet(folder / "log.parquet")
    return folder


@pytest.mark.slow
def test_a_fit_needs_only_the_file_and_a_log(folder, tmp_path, monkeypatch, capsys):
    code, _, err = run(
        monkeypatch, capsys, "fit", folder / "arm.xml", "--data", folder / "log.parquet",
        "--out", tmp_path / "fit", "--simulations", 100, "--extra-rounds", 0, "--quiet",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads((tmp_path / "fit" / "fit.json").read_text())["parameters"]
    truth = {"hand_mass": 0.3, "elbow_damping": 0.028, "servo_kp": 46.0, "servo_kv": 2.0}
    assert set(found) == set(truth)
    for name, value in truth.items():
        # Beyond 4 standard deviations once in 4000 seeds.
        assert abs(found[name]["mean"] - value) < 4.0 * found[name]["sd"], name
        assert found[name]["sd"] < 0.02 * value, name
    to = tmp_path / "identified.xml"
    code, _, err = run(
        monkeypatch, capsys, "export", tmp_path / "fit", folder / "arm.xml", "--to", to
    )
    assert code == 0, err
    arm = mujoco.MjModel.from_xml_path(str(to))
    assert arm.actuator("servo").gainprm[0] == found["servo_kp"]["mean"]
    assert arm.body("hand").mass[0] == found["hand_mass"]["mean"]


def test_inspect_shows_limits_of_joints_in_its_own_unit(folder, monkeypatch, capsys):
    """A file without ``angle="radian"`` has degrees, which is easily overlooked."""
    links = folder / "parts" / "links.xml"
    links.write_text(links.read_text().replace('name="elbow"', 'name="elbow" range="-1 2"'))
    code, out, _ = run(monkeypatch, capsys, "inspect", folder / "arm.xml")
    assert code == 0
    assert re.search(r"elbow +rad +joint limits -1 … 2", out)


def test_inspect_prints_and_writes_the_model(folder, tmp_path, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "inspect", folder / "arm.xml")
    assert code == 0
    for part in (
        "servo_kp",
        "actuator servo kp",
        "may be left out",
        "time step 0.004 s",
        "* log-normal; the range has 95 % of it",
        "payload",
        "closest fit",
    ):
        assert part in out
    code, out, _ = run(monkeypatch, capsys, "inspect", folder / "arm.xml", "--json")
    found = json.loads(out)
    assert [c["name"] for c in found["columns"] if c["role"] == "command"] == ["servo"]
    assert found["parameters"][0]["sets"] == "body hand mass_and_inertia"
    assert found["expected time"]["first fit"] > 0.0
    assert "body upper mass_and_inertia" in found["not varied"]
    written = folder / "python" / "arm.py"
    written.parent.mkdir()
    code, out, _ = run(monkeypatch, capsys, "inspect", folder / "arm.xml", "--write", written)
    assert code == 0 and f"npdr fit {written}:model" in out
    # Its path is relative to it, whatever the working directory is.
    assert 'MujocoSimulator("../arm.xml"' in written.read_text()
    monkeypatch.chdir(tmp_path)
    code, _, err = run(
        monkeypatch, capsys, "discover", f"{written}:model", "--data", folder / "log.parquet",
        "--out", tmp_path / "found", "--stage", "check", "--quiet",
    )  # fmt: skip
    assert code == 0, err


MODEL = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum

def model(inputs):
    mass = pyro.sample("mass", dist.LogNormal(0.0, 0.1))
    length = pyro.sample("length", dist.Uniform(0.5, 1.5))
    return npdr.simulate("trajectory", Pendulum(), {"mass": mass, "length": length}, inputs)
"""


def test_inspect_shows_models_in_python_and_of_the_zoo(tmp_path, monkeypatch, capsys):
    (tmp_path / "rod.py").write_text(MODEL)
    word = f"{tmp_path}/rod.py:model"
    code, out, err = run(monkeypatch, capsys, "inspect", word)
    assert code == 0, err
    for line in (
        r"mass +1 +0\.822 … 1\.217\* +kg +LogNormal\(0, 0\.1\); mass of the rod",
        r"length +1 +0\.5 … 1\.5 +m",
        r"velocity +rad/s +may be left out",
        r"torque +N m +command, -4\.5 … 4\.5",
        r"force: hinge \[N m\]",
    ):
        assert re.search(line, out), line
    code, out, _ = run(monkeypatch, capsys, "inspect", word, "--json")
    assert [p["name"] for p in json.loads(out)["parameters"]] == ["mass", "length"]
    code, out, _ = run(monkeypatch, capsys, "inspect", "pendulum")
    assert code == 0 and "npdr fit pendulum --data LOG" in out
    code, _, err = run(monkeypatch, capsys, "inspect", tmp_path / "rod.py")
    assert code == 2 and f"as in {tmp_path}/rod.py:model." in err
    code, _, err = run(monkeypatch, capsys, "inspect", word, "--write", tmp_path / "rod.toml")
    assert code == 2 and "is a model" in err


def test_a_path_may_also_be_relative_to_the_working_directory(folder, tmp_path, monkeypatch):
    from npdr_ppl.cli.resolve import resolve_model

    (tmp_path / "arm.py").write_text(
        "import npdr_ppl as npdr\nrobot = npdr.MujocoSimulator('arm.xml')\ndef model(): robot\n"
    )
    monkeypatch.chdir(folder)
    assert resolve_model(f"{tmp_path}/arm.py:model") is not None


@pytest.mark.parametrize(
    ("command", "file", "sentence"),
    [
        ("fit", "amr.xml", "amr.xml does not exist. Did you mean"),
        ("inspect", "amr.xml", "amr.xml does not exist. Did you mean"),
        ("fit", "page.xml", "page.xml is not a readable MJCF file"),
        ("inspect", "page.xml", "page.xml is not a readable MJCF file"),
        ("discover", "stone.xml", "stone.xml has no joints, so nothing in it moves."),
        (
            "fit",
            "other.xml",
            "the columns motor, j are missing; the data have",
        ),
        ("compare", "other.xml", "npdr inspect LOG --model MODEL --write"),
    ],
)
def test_a_mistake_gets_one_sentence(
    folder, tmp_path, monkeypatch, capsys, command, file, sentence
):
    (folder / "page.xml").write_text("<html><body/></html>")
    (folder / "stone.xml").write_text("<mujoco/>")
    (folder / "other.xml").write_text(
        "<mujoco><worldbody><body><joint name='j'/><geom size='1'/></body></worldbody>"
        "<actuator><motor name='motor' joint='j'/></actuator></mujoco>"
    )
    words = [command, folder / file]
    if command != "inspect":
        words += ["--data", folder / "log.parquet", "--out", tmp_path / "out"]
    if command == "compare":
        words += ["--backends", "abc"]
    code, _, err = run(monkeypatch, capsys, *words)
    assert code == 2
    assert sentence in err
    assert err.startswith("npdr: ") and err.count("\n") == 1, err
    assert not (tmp_path / "out").exists()


def test_options_for_logs_are_refused_for_a_robot(folder, monkeypatch, capsys):
    code, _, err = run(monkeypatch, capsys, "inspect", folder / "arm.xml", "--time", "t")
    assert code == 2 and "are for logs" in err


def test_the_page_shows_what_inspect_prints(tmp_path, monkeypatch, capsys):
    page = (Path(__file__).parents[2] / "docs" / "bring_your_simulator.md").read_text()
    (name, content), *_ = re.findall(r"```xml\n<!-- (\S+) -->\n(.*?)```", page, re.DOTALL)
    (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    _, out, _ = run(monkeypatch, capsys, "inspect", name)
    (shown,) = re.findall(r"```text\n(.*?)```", page, re.DOTALL)
    assert out.startswith(shown)
