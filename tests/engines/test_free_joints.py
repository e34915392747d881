"""A floating body: as a free joint, or as a ball joint on slides, where forces can act on it."""

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.models.effects import ViscousFriction
from tests.helpers.command_line import run

BODY = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="quad" pos="0 0 1">
      {joints}
      <inertial pos="0.01 0 0.02" mass="1.2" diaginertia="0.012 0.014 0.02"/>
      <site name="rotor" pos="0.2 0.1 0"/>
    </body>
  </worldbody>
  <actuator><motor name="thrust" site="rotor" gear="0 0 1 0 0 0.02"/></actuator>
</mujoco>
"""
FREE = '<freejoint name="root"/>'
SLIDES = """
<joint name="root_x" type="slide" axis="1 0 0"/>
<joint name="root_y" type="slide" axis="0 1 0"/>
<joint name="root_z" type="slide" axis="0 0 1"/>
<joint name="root" type="ball"/>
"""


def robot(tmp_path, joints, name):
    path = tmp_path / name
    path.write_text(BODY.format(joints=joints))
    return MujocoSimulator(path, time_step=0.01)


def flown(simulator, parameters=None, height=1.0):
    """Returns a flight that begins upright at a height in the file's coordinates."""
    names = [state.name for state in simulator.states]
    start = np.zeros((101, len(names)))
    start[:, names.index("root_z")] = height
    start[:, names.index("root_qw")] = 1.0
    start[:, names.index("root_x_velocity")] = 0.5
    rollouts = npdr.Rollouts.from_arrays(
        readings=[start],
        actions=[8.0 + np.sin(0.1 * np.arange(100))[:, None]],
        channel_names=names,
        action_names=["thrust"],
        time_step=0.01,
    )
    found = simulator.simulate(parameters or {}, rollouts.inputs(None, "recorded"))
    return found.reshape(-1, 100, len(names))[0], names


def test_slides_and_a_ball_joint_move_as_a_free_joint_and_have_its_columns(tmp_path):
    free = robot(tmp_path, FREE, "free.xml")
    slides = robot(tmp_path, SLIDES, "slides.xml")
    assert [state.name for state in free.states] == [state.name for state in slides.states]
    own, names = flown(free)
    # Slides count from the body's place in the file.
    other, _ = flown(slides, height=0.0)
    other[:, names.index("root_z")] += 1.0
    assert own.numpy() == pytest.approx(other.numpy(), abs=1e-9)
    assert not free.joints and {"root_x_force", "root_y_force"} <= set(slides.joints)


def test_inspect_tells_frames_and_how_to_get_forces(tmp_path, monkeypatch, capsys):
    robot(tmp_path, FREE, "free.xml")
    code, out, _ = run(monkeypatch, capsys, "inspect", tmp_path / "free.xml")
    assert code == 0
    assert "rad/s  about the body's own axes" in out
    assert "Forces on the free joint root, such as drag, are not searched for" in out


def test_drag_acts_on_slides(tmp_path):
    drag = ViscousFriction("root_x_force")
    slides = robot(tmp_path, SLIDES, "slides.xml").with_effects(drag)
    values = {drag.parameter_names[0]: torch.tensor([0.3]).double()}
    slowed, names = flown(slides, values)
    free, _ = flown(robot(tmp_path, SLIDES, "slides.xml"))
    column = names.index("root_x_velocity")
    assert slowed[10, column] < free[10, column]
