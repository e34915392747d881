"""A gripper with fingers that an equality ties, behind a servo whose command has its own unit."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco.derived_model import derive_model
from npdr_ppl.engines.mujoco.fields import find_field
from npdr_ppl.language.channels import Channel, Follower
from npdr_ppl.preparation.initial_states import estimate_starts
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import with_followers
from npdr_ppl.rollouts.logs.matching import can_be_left_out, columns_of

GRIPPER = """<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body><joint name="right" type="slide" axis="0 1 0" damping="10"/><geom size=".01" mass=".1"/></body>
    <body><joint name="left" type="slide" axis="0 1 0" damping="10"/><geom size=".01" mass=".1"/></body>
  </worldbody>
  <tendon>
    <fixed name="split"><joint joint="right" coef="0.5"/><joint joint="left" coef="0.5"/></fixed>
  </tendon>
  <equality><joint joint1="left" joint2="right" polycoef="{coefficients}"/></equality>
  <actuator>
    <general name="grip" tendon="split" gaintype="fixed" biastype="affine" ctrlrange="0 255"
             gainprm="0.0625" biasprm="0 -400 -20"/>
  </actuator>
</mujoco>"""  # noqa: E501


@pytest.fixture
def gripper(tmp_path):
    def written(coefficients="0.01 -1 0 0 0"):
        path = tmp_path / "gripper.xml"
        path.write_text(GRIPPER.format(coefficients=coefficients))
        return path

    return written


def recorded(samples=5):
    position = np.linspace(0.0, 0.04, samples)[:, None]
    return Rollouts.from_arrays(
        readings=[position], actions=[np.zeros((samples - 1, 1))], channel_names=("right",),
        action_names=("grip",), time_step=0.01,
    )  # fmt: skip


def test_a_linear_constraint_gives_either_joint_from_the_other(gripper):
    assert npdr.MujocoSimulator(gripper()).followers == (
        Follower("left", "right", (0.01, -1.0)),
        Follower("right", "left", (0.01, -1.0)),
    )
    (curved,) = npdr.MujocoSimulator(gripper("0 1 2 0 0")).followers
    assert curved == Follower("left", "right", (0.0, 1.0, 2.0))


def test_a_joint_that_follows_begins_where_it_has_to_and_is_no_measurement(gripper):
    simulator = npdr.MujocoSimulator(gripper())
    filled = with_followers(recorded(), simulator.followers)
    assert filled.channel_names == ("right", "left")
    assert filled.measured_names == ("right",)
    np.testing.assert_allclose(filled.readings[0][:, 1], 0.01 - filled.readings[0][:, 0])
    assert "left was not recorded" in filled.notes[-1]
    assert with_followers(filled, simulator.followers) is filled


def test_columns_that_follow_can_be_left_out():
    sensors = [Channel(name, "m") for name in ("left", "right")]
    sensors.append(Channel("left_velocity", "m/s", rate_of="left"))
    followers = (Follower("left", "right", (0.0, 1.0)), Follower("right", "left", (0.0, 1.0)))
    columns = columns_of(sensors, [], followers)
    assert [can_be_left_out(c, columns, {"right": 1}) for c in columns] == [True, False, True]
    assert not any(can_be_left_out(c, columns, {}) for c in columns)


def test_the_gains_of_a_servo_whose_command_has_its_own_unit(gripper):
    model = npdr.MujocoSimulator(gripper()).model
    kp = find_field(model, "actuator grip kp")
    assert kp.nominal == 400.0
    assert sorted(entry.number(800.0) for entry in kp.entries) == [-800.0, 0.125]
    assert find_field(model, "actuator grip kv").nominal == 20.0
    names = {p.name for p in derive_model(gripper()).parameters}
    assert {"grip_kp", "grip_kv"} & names


def test_a_segment_begins_with_the_fingers_as_far_apart_as_the_model_has_them(gripper):
    # The constraint is soft, and one finger is heavier.
    path = gripper("0 1 0 0 0")
    text = path.read_text().replace('mass=".1"', 'mass=".5"', 1)
    apart = '<option timestep="0.002"><flag contact="disable"/></option>'
    path.write_text(text.replace('<option timestep="0.002"/>', apart))
    simulator = npdr.MujocoSimulator(path, {"damping": "joint left damping"}, time_step=0.01)
    commands = 120.0 + 100.0 * np.sign(np.sin(0.15 * np.arange(200)))[:, None]
    whole = Rollouts.from_arrays(
        readings=[np.zeros((201, 4))], actions=[commands], action_names=("grip",), time_step=0.01,
        channel_names=[channel.name for channel in simulator.states],
    )  # fmt: skip
    moved = simulator.simulate({}, whole.inputs(None, "recorded")).reshape(200, 4).numpy()
    names = whole.channel_names
    right, left = (np.append(0.0, moved[:, names.index(name)]) for name in ("right", "left"))
    assert np.abs(right - left).max() > 1e-4

    def model(inputs):
        damping = pyro.sample("damping", dist.Uniform(5.0, 15.0))
        return npdr.simulate("trajectory", simulator, {"damping": damping}, inputs, noise=None)

    noise = np.random.default_rng(0).normal(0.0, 1e-6, len(right))
    recording = Rollouts.from_arrays(
        readings=[(right + noise)[:, None]], actions=[commands], channel_names=("right",),
        action_names=("grip",), time_step=0.01,
    )  # fmt: skip
    rollouts = with_followers(recording, simulator.followers)
    segments = SegmentModel(model, rollouts, npdr.DataOptions(segment_length=20))
    z = segments.place_of({"damping": torch.tensor(10.0)})
    starts = estimate_starts(segments.black_box(z[None]), segments.inputs, rollouts)
    later = segments.inputs.start[1:]
    column = rollouts.channel_names.index("left")
    wrong = segments.inputs.initial_values[1:, column].numpy() - left[later]
    found = starts.values[1:, column].numpy() - left[later]
    assert np.abs(found).max() < 0.1 * np.abs(wrong).max()
