"""A floating body, as a free joint or as a ball joint on slides, and the forces at its axes."""

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Spin
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    CoulombFriction,
    QuadraticDrag,
    ViscousFriction,
    candidate_effects,
    effects,
)
from npdr_ppl.rollouts.collection import with_followers
from tests.helpers.command_line import run
from tests.helpers.exported_robots import difference

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
PORTS = tuple(f"root_{axis}_{kind}" for kind in ("force", "torque") for axis in "xyz")
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
    assert free.joints == slides.joints == PORTS


def test_spins_follow_from_a_quaternion_of_either_sign():
    orientations, spins, quaternion = [], [], np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(10_000):  # steps of 0.1 ms, every hundredth of which is recorded
        time = 1e-4 * k
        spin = np.array([np.sin(3.0 * time), 0.5 * np.cos(2.0 * time), 1.0 + 0.3 * np.sin(time)])
        if k % 100 == 0:
            orientations.append(quaternion * (-1.0) ** (k % 300 == 0))
            spins.append(spin)
        w, turn = quaternion[0], quaternion[1:]
        rate = np.array([-turn @ spin, *(w * spin + np.cross(turn, spin))])
        quaternion = quaternion + 0.5e-4 * rate
        quaternion /= np.linalg.norm(quaternion)
    recorded, wanted = np.array(orientations), np.array(spins)
    for axis in range(3):
        found = Spin("spin", axis, ("w", "x", "y", "z")).follow(recorded, 0.01)
        assert found[1:-1] == pytest.approx(wanted[1:-1, axis], abs=1e-3)
        assert found == pytest.approx(wanted[:, axis], abs=2e-2)
    recorded[5] = np.nan
    found = Spin("spin", 0, ("w", "x", "y", "z")).follow(recorded, 0.01)
    assert np.isnan(found).nonzero()[0].tolist() == [4, 6]


def test_spins_may_be_left_out_of_a_recording(tmp_path):
    free = robot(tmp_path, FREE, "free.xml")
    own, names = flown(free)
    recorded = [n for n in names if not n.endswith("_spin")]
    rollouts = npdr.Rollouts.from_arrays(
        readings=[own[:, [names.index(n) for n in recorded]].numpy()],
        actions=[np.zeros((99, 1))],
        channel_names=recorded,
        action_names=["thrust"],
        time_step=0.01,
    )
    whole = with_followers(rollouts, free.followers)
    assert set(whole.channel_names) == set(names)
    assert set(whole.measured_names) == set(recorded)
    assert "root_x_spin was not recorded: it follows from root_qw, root_qx" in str(whole.notes)
    whole.check(free.sensors, free.actions)


def test_inspect_tells_frames_and_ports(tmp_path, monkeypatch, capsys):
    robot(tmp_path, FREE, "free.xml")
    code, out, _ = run(monkeypatch, capsys, "inspect", tmp_path / "free.xml")
    assert code == 0
    assert "rad/s  may be left out; about the body's own axes" in out
    assert "closest fit" in out
    assert "force on a floating body, along and about its own axes: root_x_force [N]" in out


ADRIFT = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <body name="hull">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.1 0.2 0.2"/>
    </body>
  </worldbody>
</mujoco>
"""


def drifting(tmp_path, effect, value, start):
    """Returns the states of a body that nothing else moves, after each of 100 steps of 0.01 s."""
    path = tmp_path / "hull.xml"
    path.write_text(ADRIFT)
    simulator = MujocoSimulator(path, time_step=0.01).with_effects(effect)
    names = [state.name for state in simulator.states]
    rest = {"root_qw": 1.0} | start
    inputs = Inputs.single(
        torch.zeros(100, 0).double(),
        torch.tensor([rest.get(name, 0.0) for name in names]).double(),
        action_names=(),
        state_names=tuple(names),
        time_step=0.01,
    )
    found = simulator.simulate({effect.parameter_names[0]: torch.tensor([value])}, inputs)
    return {name: found.reshape(100, -1)[:, i].numpy() for i, name in enumerate(names)}


TIME = 0.01 * np.arange(1, 101)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_drag_acts_along_the_axes_of_the_body(tmp_path, axis):
    # The body points along the world's y-axis, and moves there.
    turned = {"root_qw": 0.5**0.5, "root_qz": 0.5**0.5, "root_y_velocity": 3.0}
    found = drifting(tmp_path, ViscousFriction(f"root_{axis}_force"), 1.5, turned)
    decay = np.exp(-1.5 / 2.0 * TIME) if axis == "x" else np.ones(100)
    assert found["root_y_velocity"] == pytest.approx(3.0 * decay, rel=1e-3)
    assert np.abs(found["root_x_velocity"]).max() < 1e-9


def test_drag_turns_with_the_body(tmp_path):
    # v' = −(c/m) (e·v) e with e = (cos ωt, sin ωt), here by steps of 0.1 ms.
    start = {"root_x_velocity": 1.0, "root_z_spin": 4.0}
    found = drifting(tmp_path, ViscousFriction("root_x_force"), 3.0, start)
    velocity, wanted = np.array([1.0, 0.0]), []
    for k in range(10_000):
        angle = 4.0 * (k + 0.5) * 1e-4
        axis = np.array([np.cos(angle), np.sin(angle)])
        velocity = velocity - 1e-4 * 1.5 * (axis @ velocity) * axis
        if (k + 1) % 100 == 0:
            wanted.append(velocity)
    both = np.stack([found["root_x_velocity"], found["root_y_velocity"]], axis=1)
    assert both == pytest.approx(np.array(wanted), abs=2e-3)


def test_drag_about_an_axis_slows_the_spin(tmp_path):
    found = drifting(tmp_path, QuadraticDrag("root_y_torque"), 0.3, {"root_y_spin": 5.0})
    assert found["root_y_spin"] == pytest.approx(5.0 / (1.0 + 1.5 * 5.0 * TIME), rel=5e-3)


def test_what_needs_a_bearing_or_a_position_is_refused(tmp_path):
    simulator = robot(tmp_path, FREE, "free.xml")
    acting = {name for name, e in effects().items() if getattr(e, "acts_on_floating", False)}
    assert acting == {"viscous_friction", "quadratic_drag"}
    proposed = {e.id for e in candidate_effects(simulator) if e.port == "root_y_torque"}
    assert proposed == acting
    with pytest.raises(ModelError, match="coulomb_friction cannot attach to 'root_x_force'"):
        simulator.with_effects(CoulombFriction("root_x_force"))

    class Sticking(CoulombFriction):
        acts_on_floating = True

    with pytest.raises(ModelError, match="no bearing that rubs"):
        simulator.with_effects(Sticking("root_x_force"))


def test_a_port_has_a_name_of_its_own(tmp_path):
    joints = '<joint name="root_x" axis="1 0 0"/><joint name="root" type="ball"/>'
    names = robot(tmp_path, joints, "neck.xml").joints
    assert names == (
        "root_x_torque", "root_x_torque_at_joint", "root_y_torque", "root_z_torque",
    )  # fmt: skip
    bodies = '<body><joint name="root_x_torque" axis="1 0 0"/><geom size="0.1"/></body>'
    path = tmp_path / "two.xml"
    path.write_text(
        f'<mujoco><worldbody><body><joint name="root" type="ball"/><geom size="0.1"/>{bodies}'
        "</body></worldbody></mujoco>"
    )
    names = MujocoSimulator(path).joints
    assert len(set(names)) == len(names) == 4


def test_speeds_are_those_along_the_axes_of_the_body(tmp_path):
    free = robot(tmp_path, FREE, "free.xml")
    names = tuple(state.name for state in free.states)
    # The body points along the world's y-axis.
    start = {"root_qw": 1.0, "root_qz": 1.0, "root_y_velocity": 3.0, "root_x_velocity": 0.2}
    inputs = Inputs.single(
        torch.zeros(5, 1).double(),
        torch.tensor([start.get(name, 0.0) for name in names]).double(),
        action_names=("thrust",),
        state_names=names,
        time_step=0.01,
    )
    speeds = free.speeds_at_starts(inputs)
    assert speeds.keys() == set(PORTS)
    assert float(speeds["root_x_force"]) == pytest.approx(3.0)
    assert float(speeds["root_y_force"]) == pytest.approx(-0.2)


@pytest.mark.parametrize("port", ["root_x_force", "root_y_torque"])
@pytest.mark.parametrize("joints", [FREE, SLIDES], ids=["free", "slides"])
def test_an_exported_body_drags_as_ours(tmp_path, joints, port):
    drags = [ViscousFriction(port), QuadraticDrag("root_z_force")]
    simulator = robot(tmp_path, joints, "own.xml").with_effects(*drags)
    values = {drag.parameter_names[0]: 0.3 for drag in drags}
    error, matters, _ = difference(simulator, values, tmp_path, velocity=0.5)
    assert error < 1e-4
    assert matters > 1e-3
