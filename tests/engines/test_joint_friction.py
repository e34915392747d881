"""Friction of each joint is recovered from torques that MuJoCo's own inverse dynamics gives."""

import math
from dataclasses import replace

import numpy as np
import pytest

from npdr_ppl.engines.mujoco.joint_friction import identify_friction
from npdr_ppl.errors import DataError, ModelError
from tests.engines.test_payload import JOINTS, arm, recorded

DAMPING = 0.5, 0.4, 0.3, 0.1
"""Viscous friction of the arm's joints, N m s/rad; each joint has 0.3 N m of dry friction."""


@pytest.fixture(scope="module")
def recording():
    return recorded(arm(), noise=0.2)


@pytest.fixture
def robot(tmp_path):
    # The file's masses are wrong, which must not matter.
    path = tmp_path / "arm.xml"
    path.write_text(arm(hand_mass=1.7))
    return path


def test_friction_is_found_in_the_whole_recording_and_in_its_halves(robot, recording):
    found = identify_friction(robot, recording)
    assert tuple(found) == JOINTS
    for friction, damping in zip(found.values(), DAMPING, strict=True):
        assert friction.dry == pytest.approx(0.3, abs=0.03)
        assert friction.viscous == pytest.approx(damping, abs=0.03)
        assert friction.half_dry == pytest.approx((0.3, 0.3), abs=0.06)
        assert friction.half_viscous == pytest.approx((damping, damping), abs=0.06)
        assert friction.error < friction.error_without and 0.0 < friction.share < 1.0


def test_no_friction_is_found_without_torques(robot, recording):
    silent = replace(recording, actions=tuple(0.0 * values for values in recording.actions))
    for friction in identify_friction(robot, silent).values():
        assert (friction.dry, friction.viscous) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("is_moving", [True, False])
def test_friction_that_the_motion_does_not_determine_is_not_a_number(robot, recording, is_moving):
    """Of a joint that moves in one direction only, dry friction is a constant torque."""
    (motion,), (torques,) = recording.readings, recording.actions
    time = recording.time_step * np.arange(len(motion))
    motion = np.array(motion)
    motion[:, 0] = time + 0.3 * np.sin(2.0 * time) if is_moving else 0.3
    changed = replace(recording, readings=(motion,), actions=(0.0 * torques,))
    base, *others = identify_friction(robot, changed).values()
    assert all(map(math.isnan, (base.dry, *base.half_dry)))
    assert math.isnan(base.viscous) != is_moving
    assert base.share == 0.0
    for friction in others:
        assert (friction.dry, friction.viscous) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_bad_input_is_refused(robot, recording, tmp_path):
    with pytest.raises(DataError, match="no channels wrist"):
        identify_friction(robot, recording.select(JOINTS[:3]))
    with pytest.raises(DataError, match="record longer rollouts"):
        identify_friction(robot, recorded(arm(), num_steps=100))
    floating = tmp_path / "ball.xml"
    body = '<body name="b"><freejoint/><geom size="0.1"/></body>'
    floating.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ModelError, match="free or ball joints"):
        identify_friction(floating, recording)
