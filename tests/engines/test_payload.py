"""A load is recovered from torques that MuJoCo's own inverse dynamics gives."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco.payload import identify_payload
from npdr_ppl.errors import DataError, ModelError

STEP = 0.01
JOINTS = ("base", "shoulder", "elbow", "wrist")
LOAD = '<inertial pos="0.05 -0.1 0.15" mass="0.8" diaginertia="1e-3 1e-3 1e-3"/>'


def arm(load="", hand_mass=0.4):
    """An arm of four hinges that turn about different axes."""
    joint = 'damping="{}" armature="0.02"'
    body = '<body name="{}" pos="{}"><joint name="{}" axis="{}" {}/><inertial pos="{}" mass="{}" '
    body += 'diaginertia="0.02 0.02 0.01"/>'
    parts = [
        ("column", "0 0 0.1", "base", "0 0 1", joint.format(0.5), "0.02 0 0.05", 2.0),
        ("upper", "0 0 0.1", "shoulder", "0 1 0", joint.format(0.4), "0 0.01 0.2", 1.5),
        ("lower", "0 0 0.4", "elbow", "0 1 0", joint.format(0.3), "0 0.02 0.15", 1.0),
        ("hand", "0 0 0.3", "wrist", "1 0 0", joint.format(0.1), "0.01 0 0.05", hand_mass),
    ]
    motors = "".join(f'<motor name="{name}_motor" joint="{name}"/>' for name in JOINTS)
    carried = f'<body name="load">{load}</body>' if load else ""
    return (
        "<mujoco><worldbody>"
        + "".join(body.format(*part) for part in parts)
        + carried
        + "</body>" * len(parts)
        + f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def recorded(text, *, num_steps=3000, noise=0.0, seed=0):
    """The arm follows sines; its torques are those of MuJoCo's inverse dynamics, and friction."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    time = STEP * np.arange(num_steps + 1)
    rates = 2.0 * np.pi * np.array([0.11, 0.17, 0.23, 0.31])
    positions = np.sin(time[:, None] * rates) + 0.3 * np.sin(time[:, None] * 2.3 * rates)
    velocities, accelerations = np.zeros((2, len(time), 4))
    for factor, size in ((1.0, 1.0), (2.3, 0.3)):
        w = factor * rates
        velocities += size * w * np.cos(time[:, None] * w)
        accelerations -= size * w**2 * np.sin(time[:, None] * w)
    torques = []
    for motion in zip(positions, velocities, accelerations, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse + 0.3 * np.sign(data.qvel) + [0.0, 0.2, -0.1, 0.0])
    # A command is held until the next measurement.
    held = 0.5 * (np.array(torques)[1:] + np.array(torques)[:-1])
    rng = np.random.default_rng(seed)
    return npdr.Rollouts.from_arrays(
        readings=[positions + 1e-4 * rng.standard_normal(positions.shape)],
        actions=[held + noise * rng.standard_normal(held.shape)],
        channel_names=JOINTS,
        action_names=tuple(f"{name}_motor" for name in JOINTS),
        time_step=STEP,
    )


@pytest.fixture(scope="module")
def recordings():
    return recorded(arm(), noise=0.2), recorded(arm(LOAD), noise=0.2, seed=1)


@pytest.fixture
def robot(tmp_path):
    # The file's masses are wrong, which must not matter.
    path = tmp_path / "arm.xml"
    path.write_text(arm(hand_mass=1.7))
    return path


def test_mass_and_centre_are_found_in_the_whole_recording_and_in_its_halves(robot, recordings):
    load = identify_payload(robot, *recordings, "hand")
    assert load.mass == pytest.approx(0.8, rel=0.03)
    assert load.centre == pytest.approx((0.05, -0.1, 0.15), abs=0.01)
    assert load.half_masses == pytest.approx((0.8, 0.8), rel=0.06)
    for bare, ignored, known in load.errors.values():
        assert known < 1.5 * bare
        assert ignored > known
    assert max(ignored / known for _, ignored, known in load.errors.values()) > 5.0


def test_no_load_is_found_where_there_is_none(robot, recordings):
    again = recorded(arm(), noise=0.2, seed=2)
    assert abs(identify_payload(robot, recordings[0], again, "hand").mass) < 0.02


def test_a_mass_that_the_motion_does_not_tell_is_refused(robot, recordings):
    with pytest.raises(DataError, match="does not tell the mass of a load at 'column'"):
        identify_payload(robot, *recordings, "column")


def test_recordings_without_torques_are_refused(robot, recordings):
    silent = [
        replace(recording, actions=tuple(0.0 * values for values in recording.actions))
        for recording in recordings
    ]
    with pytest.raises(DataError, match="contain no torques"):
        identify_payload(robot, *silent, "hand")


def test_bad_input_is_refused(robot, recordings, tmp_path):
    with pytest.raises(ModelError, match="no moving body 'hnd'; did you mean 'hand'"):
        identify_payload(robot, *recordings, "hnd")
    with pytest.raises(DataError, match="no channels wrist"):
        identify_payload(robot, recordings[0].select(JOINTS[:3]), recordings[1], "hand")
    short = recorded(arm(), num_steps=100)
    with pytest.raises(DataError, match="record longer rollouts"):
        identify_payload(robot, short, recordings[1], "hand")
    floating = tmp_path / "ball.xml"
    body = '<body name="b"><freejoint/><geom size="0.1"/></body>'
    floating.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ModelError, match="free or ball joints"):
        identify_payload(floating, *recordings, "b")
