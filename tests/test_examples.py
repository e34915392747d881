"""The examples run, at a size that a test can afford."""

import importlib.util
import json
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pyro
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.rollouts.collection import with_commands

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def fleet():
    spec = importlib.util.spec_from_file_location("fleet_example", EXAMPLES / "fleet.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_fleet_learns_a_likelihood_and_samples_hyper_parameters(fleet):
    inputs = fleet.chirp()
    learnt = fleet.learn(inputs, num_simulations=1000, seed=0)
    truth = fleet.draw_fleet(inputs, seed=1)
    assert truth.readings.shape == (fleet.NUM_ROLLOUTS, fleet.NUM_RIGS, 1, fleet.NUM_STEPS, 4)
    model = npdr.with_likelihood(fleet.fleet, learnt)
    draws = fleet.run_nuts(pyro.condition(model, {"readings": truth.readings}), inputs, 6, seed=2)
    assert draws["coordinates"].shape == (6, fleet.NUM_RIGS, len(fleet.RANGES))
    assert draws["mean"].isfinite().all()
    assert len(fleet.coverage(draws, truth)) == 2 * len(fleet.RANGES)


@pytest.mark.parametrize(
    ("file", "name", "mapping", "position"),
    [
        ("ur10e_joint.py", "joint", "ur10e_joint_2.toml", "joint_2_position"),
        ("ur10e_joint.py", "joint", "ur10e_joint_4.toml", "joint_4_position"),
        ("dfki_pendulum.py", "dfki_pendulum", "dfki_pendulum.toml", "position"),
        ("furuta_odrive.py", "pole", "furuta_odrive.toml", "pole_position"),
    ],
)
def test_a_rig_of_the_gallery_reads_its_log_and_can_be_fitted(file, name, mapping, position):
    time = 0.01 * np.arange(300)
    columns = {position: 0.3 * np.sin(4.0 * time), "torque": np.sin(7.0 * time)}
    columns[position.replace("position", "velocity")] = 1.2 * np.cos(4.0 * time)
    columns[position.replace("position", "current")] = np.sin(7.0 * time)
    log = pd.DataFrame({"time": time, **columns})
    rollouts = npdr.Rollouts.from_dataframe(log, EXAMPLES / "gallery" / mapping)
    rollouts = with_commands(rollouts, Pendulum.actions)  # the pole swings freely
    model = runpy.run_path(str(EXAMPLES / "gallery" / file))[name]
    inputs = rollouts.inputs(20)
    trajectories = pyro.infer.Predictive(model, num_samples=3)(inputs)["trajectory"]
    assert trajectories.shape[0] == 3 and trajectories.isfinite().all()


def test_the_driven_rig_of_the_gallery_reads_its_log_and_can_be_simulated():
    time = 0.002 * np.arange(300)
    log = pd.DataFrame({"time": time, "voltage": np.sin(7.0 * time)})
    for joint, rest in (("arm", 80.0), ("pole", -6.0 * np.pi)):
        log[f"{joint}_position"] = rest + 0.3 * np.sin(4.0 * time)
        log[f"{joint}_velocity"] = 1.2 * np.cos(4.0 * time)
    gallery = EXAMPLES / "gallery"
    rollouts = npdr.Rollouts.from_dataframe(log, gallery / "furuta_odrive_driven.toml")
    model = runpy.run_path(str(gallery / "furuta_odrive_driven.py"))["furuta"]
    inputs = rollouts.inputs(20)
    trajectories = pyro.infer.Predictive(model, num_samples=3)(inputs)["trajectory"]
    assert trajectories.shape[0] == 3 and trajectories.isfinite().all()


@pytest.mark.parametrize(
    ("name", "signal"), [("wrist_pitch", "wrist_flex"), ("pan", "shoulder_pan")]
)
def test_a_servo_of_the_gallery_follows_its_goal(name, signal):
    time = 0.02 * np.arange(300)
    goal = np.sin(2.0 * time)
    log = pd.DataFrame({"time": time, f"{signal}_command": goal})
    log[f"{signal}_position"] = np.sin(2.0 * time - 0.15)
    log[f"{signal}_velocity"] = 2.0 * np.cos(2.0 * time - 0.15)
    gallery = EXAMPLES / "gallery"
    rollouts = npdr.Rollouts.from_dataframe(log, gallery / f"so101_{name}.toml")
    model = runpy.run_path(str(gallery / "so101_joint.py"))[name]
    values = {"inertia": 0.03, "stiffness": 10.5, "damping": 0.75}
    known = pyro.condition(model, {k: torch.tensor(v) for k, v in values.items()})
    inputs = rollouts.inputs()
    trajectory = pyro.infer.Predictive(known, num_samples=1)(inputs)["trajectory"]
    # The steady response to a goal of 2 rad/s, which is held for 0.02 s.
    inertia = values["inertia"] if name == "wrist_pitch" else 0.093
    response = 10.5 / (10.5 - inertia * 2.0**2 + 2.0j * 0.75)
    late = np.imag(response * np.exp(2.0j * (time - 0.01)))
    sag = trajectory[..., 0].flatten().numpy()[100:] - late[-trajectory.shape[-2] :][100:]
    weight = 0.117 if name == "wrist_pitch" else 0.0
    assert np.abs(sag - weight / 10.5 * np.cos(late[-len(sag) :])).max() < 0.001


def test_the_servo_with_a_pendulum_reads_its_log_and_sags_under_its_weight(tmp_path, monkeypatch):
    time = 0.005 * np.arange(3000)
    entry = {"position": 0.3, "speed": 0.0, "goal_position": 0.5}
    log = {"motor": "xl330", "kp": 400, "trajectory": "hold"}
    log["entries"] = [{**entry, "timestamp": float(t)} for t in time]
    (tmp_path / "log.json").write_text(json.dumps(log))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["bam_to_csv.py", "log.json"])
    gallery = EXAMPLES / "gallery"
    runpy.run_path(str(gallery / "bam_to_csv.py"))
    rollouts = npdr.Rollouts.load("xl330_kp400_hold.csv", gallery / "xl330.toml")
    robot = npdr.MujocoSimulator(gallery / "xl330.xml", time_step=rollouts.time_step)
    angle = float(robot.simulate({}, rollouts.inputs(None, "recorded"))[0, -1, 0])
    assert 1.0 * (0.5 - angle) == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(angle), abs=1e-4)


LINKS = "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"


@pytest.fixture
def six_joints(tmp_path):
    """An arm of six joints, and logs of it without and with a load."""
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    bodies = motors = ""
    for k, (joint, link) in enumerate(zip(joints, LINKS, strict=True)):
        axis = "1 0 0" if k % 2 else "0 1 0"
        bodies += f'<body name="{link}_link" pos="0 0 0.2"><joint name="{joint}_joint" '
        bodies += f'axis="{axis}"/><geom size="0.05" pos="0.02 0.01 0.1"/>'
        motors += f'<motor name="{joint}_joint_motor" joint="{joint}_joint"/>'
    robot = tmp_path / "arm.xml"
    ends = f"{'</body>' * 6}</worldbody><actuator>{motors}</actuator></mujoco>"
    robot.write_text(f"<mujoco><worldbody>{bodies}{ends}")
    rng, time = np.random.default_rng(0), 0.01 * np.arange(800)
    for name in ("unload", "load"):
        log = pd.DataFrame({"time": time})
        for k in range(1, 7):
            noise = rng.normal(0.0, [[1e-4], [1.0]], (2, len(time)))
            log[f"joint_{k}_position"] = np.sin((1.0 + 0.3 * k) * time) + noise[0]
            log[f"joint_{k}_current"] = noise[1]
        log.to_parquet(tmp_path / f"{name}.parquet")
    return robot, [str(tmp_path / f"{name}.parquet") for name in ("unload", "load")]


def test_the_script_of_the_payload_prints_a_load_for_each_link(six_joints, tmp_path, capsys):
    robot, logs = six_joints
    gallery = EXAMPLES / "gallery"
    main = runpy.run_path(str(gallery / "ur10e_payload.py"))["main"]
    figure = tmp_path / "payload.png"
    for gains in ("identified", "published"):
        mapping = str(gallery / f"ur10e_arm_{gains}_gains.toml")
        main(str(robot), mapping, *logs, str(figure))
        lines = capsys.readouterr().out.splitlines()[1:]
        assert [line.split()[0] for line in lines] == [*LINKS[2:]]
    assert figure.stat().st_size > 1000


def test_the_script_of_friction_prints_each_joint(six_joints, capsys):
    robot, logs = six_joints
    gallery = EXAMPLES / "gallery"
    main = runpy.run_path(str(gallery / "ur10e_friction.py"))["main"]
    main(str(robot), str(gallery / "ur10e_arm_identified_gains.toml"), logs[0])
    header, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6 and lines[0].startswith("shoulder_pan_joint")
    assert header.index("share") + len("share") == len(lines[0])
