"""Whole arms behind servos: the rigs, the cases' sizes, and how rows are judged."""

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from servo_arms import tasks
from servo_arms_cases import KINDS, Task, make_case, recorded
from servo_arms_links import ARMS, TIME_STEP, mjcf
from servo_arms_rigs import LAWS, Hidden, changed, simulate
from servo_arms_rows import is_false_alarm, is_right, is_wrong_without_doubt, lines, one_device

from npdr_ppl.models.effects.registry import effects
from npdr_ppl.models.effects.surroundings import Tilt

mujoco: Any = importlib.import_module("mujoco")

SIX = ARMS["six"]


def commands(arm, seconds=0.2):
    """Returns a swing of all joints from rest."""
    times = TIME_STEP * np.arange(round(seconds / TIME_STEP))[:, None]
    home = np.array([link.home for link in arm.links])
    return home + 0.3 * np.sin(4.0 * times + np.arange(len(home)))


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_arms_compile_and_can_carry_themselves(arm):
    model = mujoco.MjModel.from_xml_string(mjcf(arm, arm.public))
    assert model.nv == model.nu == len(arm.links)
    assert model.opt.timestep == TIME_STEP
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    data.qpos[:] = [link.home for link in arm.links]
    mujoco.mj_forward(model, data)
    limits = [link.limit for link in arm.links]
    assert (np.abs(data.qfrc_bias) < 0.9 * np.array(limits)).all()


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_a_recording_is_finite_and_its_seed_decides_it(arm):
    own = [commands(arm)]
    first, again, other = (recorded(arm, arm.public, own, (), 4, seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    readings = first.readings[0]
    assert readings.shape == (len(own[0]) + 1, len(arm.links))
    assert np.isfinite(readings).all()
    # Servos follow with a lag of about a tenth of a second.
    assert np.abs(readings[1:] - own[0]).max() < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_an_effect_changes_the_recording(kind):
    joint = None if KINDS[kind].place in ("bus", "payload", "gravity") else 2
    size = 2.0 if kind in LAWS and kind != "load_friction" else 0.01
    effect = Hidden(kind, joint, (size,) * KINDS[kind].numbers)
    own = commands(SIX)
    without = simulate(SIX, SIX.public, own)
    change = np.abs(simulate(SIX, SIX.public, own, [effect]) - without).max()
    half = np.abs(simulate(SIX, SIX.public, own, [effect.scaled(0.5)]) - without).max()
    assert change > 1e-5
    assert half == pytest.approx(0.5 * change, rel=0.2)


def test_commands_are_late_by_no_whole_number_of_steps():
    own = commands(SIX)
    without = simulate(SIX, SIX.public, own)
    late = simulate(SIX, SIX.public, own, [Hidden("bus_delay", None, (0.0033,))])
    times = TIME_STEP * np.arange(len(without))
    for joint in range(len(SIX.links)):
        shifted = np.interp(times - 0.0033, times, without[:, joint])
        assert np.abs(late - without)[5:, joint].max() > 5e-4
        assert np.abs(late[5:, joint] - shifted[5:]).max() < 2e-5


def test_gravity_turns_as_in_the_catalogue():
    roll, pitch = 0.03, -0.02
    values = {"roll": torch.tensor(roll).double(), "pitch": torch.tensor(pitch).double()}
    expected = Tilt("gravity").environment(torch.tensor([0.0, 0.0, -9.81]).double(), values)
    tilted = Hidden("tilt", None, (roll, pitch))
    assert changed(SIX, [tilted])["gravity"] == pytest.approx(expected.tolist())


def test_tasks_take_all_kinds_in_turn():
    found = list(tasks(["one", "none"], list(ARMS), list(KINDS), [0.0, 30.0], "known", range(12)))
    assert len(found) == 48
    for arm in ARMS:
        own = [task for task in found if task.arm == arm and task.condition == "one"]
        assert {task.kinds[0] for task in own} == set(KINDS)
        assert {task.separation for task in own} == {0.0, 30.0}


@pytest.mark.slow
def test_a_case_has_the_separation_and_what_a_user_needs(tmp_path, monkeypatch):
    monkeypatch.setattr("servo_arms_cases.SECONDS", 2.0)
    case = make_case(Task("six", "one", ("viscous_friction",), 30.0, "known", 0))
    assert 30.0 <= case.separations[0] < 45.0
    (name,) = case.truth
    joint = name.removesuffix("_torque.viscous_friction")
    assert joint in SIX.joints
    # Damping would take its place.
    assert f"damping_{joint}" not in case.addresses
    assert len(case.addresses) == 11
    case.write(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"arm.xml", "arm_model.py", "rec.npz"}
    assert len(case.rollouts) == 3


def test_every_kind_but_one_is_in_the_catalogue():
    assert {kind.effect for kind in KINDS.values()} - set(effects()) <= {"servo_gain"}


def finding(name, probability=0.99, equivalent=(), **alternatives) -> dict[str, Any]:
    port, effect = name.rsplit(".", 1)
    return {
        "effect": effect,
        "port": port,
        "probability": probability,
        "alternatives": {name: probability} | alternatives,
        "equivalent_to": list(equivalent),
        "share": 0.9,
    }


def row(truth, *found, verdict="named", **others) -> dict[str, Any]:
    return {
        "condition": ("none", "one", "two")[min(len(truth), 2)],
        "truth": list(truth),
        "alternatives": [],
        "is_in_catalogue": True,
        "message": "",
        "verdict": verdict,
        "effects": list(found),
        "seconds": 60.0,
        "cpu_seconds": 90.0,
        "peak_mib": 512.0,
    } | others


DRY, BIAS = "elbow_torque.coulomb_friction", "wrist_1_torque.bias"
LATE = "elbow_servo.input_delay"


def test_right_is_what_is_hidden_and_nothing_else():
    assert is_right(row([DRY], finding(DRY)))
    assert is_right(row([DRY, BIAS], finding(BIAS), finding(DRY)))
    assert not is_right(row([DRY, BIAS], finding(DRY)))
    assert not is_right(row([DRY], finding(DRY), finding(BIAS)))
    assert not is_right(row([DRY], finding(DRY), verdict="unknown"))
    assert not is_right(row([DRY], message="ended after 1800 s"))
    assert is_right(row([DRY], finding(DRY), finding(BIAS) | {"is_minor": True}))
    other = finding("elbow_torque.presliding_friction", 0.6, **{DRY: 0.4})
    assert is_right(row([DRY], other, verdict="ambiguous"))
    assert is_right(
        row([BIAS], finding("wrist_1.encoder_bias"), alternatives=[["wrist_1.encoder_bias"]])
    )


def test_a_class_is_right_at_its_own_joint_only():
    for joint, expected in (("elbow", True), ("wrist_1", False)):
        sensor = finding(f"{joint},{joint}_velocity.sensor_delay", equivalent=["input_delay"])
        assert is_right(row([LATE], sensor)) is expected
        assert is_wrong_without_doubt(row([LATE], sensor)) is not expected


def test_a_delay_of_all_servos_has_several_right_names():
    servos = ",".join(link.servo for link in SIX.links)
    each = [f"{link.servo}.input_delay" for link in SIX.links]
    positions = ",".join(SIX.joints)
    sensors = f"{positions}.sensor_delay"
    found = f"{positions},{','.join(f'{j}_velocity' for j in SIX.joints)}.sensor_delay"
    hidden = {"truth": [f"{servos}.input_delay"], "alternatives": [each, [sensors]]}
    assert is_right(row([], finding(f"{servos}.input_delay")) | hidden)
    assert is_right(row([], *map(finding, each)) | hidden)
    assert not is_right(row([], *map(finding, each[:5])) | hidden)
    assert is_right(row([], finding(found)) | hidden)
    assert one_device(found) == sensors


def test_what_no_catalogue_has_is_unknown():
    gain = "elbow_servo.servo_gain"
    unknown = row([gain], finding(DRY), verdict="unknown", is_in_catalogue=False)
    assert is_right(unknown)
    assert not is_wrong_without_doubt(unknown)
    named = row([gain], finding(DRY), is_in_catalogue=False)
    assert not is_right(named)
    assert is_wrong_without_doubt(named)


def test_the_summary_has_the_targets():
    nothing = row([], verdict="none")
    alarm = row([], finding(DRY))
    assert is_right(nothing)
    assert not is_false_alarm(nothing)
    assert is_false_alarm(alarm)
    late = row([DRY], message="ended after 1800 s", seconds=1800.0)
    found = {line.label: line for line in lines([row([DRY], finding(DRY)), late, nothing, alarm])}
    assert found["one or two effects: right, nothing else named"].shown.startswith("1 of 2 ")
    assert found["nothing hidden: false alarms"].shown.startswith("1 of 2 ")
    assert found["wrong without doubt"].shown.startswith("1 of 4 ")
    assert found["no verdict: failed, or not in time"].is_met is False
    assert found["median time"].is_met is True
    assert found["worst time"].is_met is False
