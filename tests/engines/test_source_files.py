"""Runs record the files that describe a robot, and can be made again from the record."""

import hashlib
import json

import mujoco
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.bullet import BulletSimulator, Sensor
from npdr_ppl.engines.common.source_files import OUTSIDE, recorded_files
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.rollouts import Rollouts

ROBOT = """
<mujoco>
  <compiler meshdir="meshes"/>
  <include file="parts/arm.xml"/>
  <asset><mesh name="hand" file="hand.obj"/></asset>
</mujoco>
"""
ARM = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="hinge" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def robot(folder):
    (folder / "parts").mkdir(parents=True)
    (folder / "meshes").mkdir()
    (folder / "robot.xml").write_text(ROBOT)
    (folder / "parts" / "arm.xml").write_text(ARM)
    (folder / "meshes" / "hand.obj").write_text(TETRAHEDRON)
    return folder / "robot.xml"


def inputs(simulator):
    return Inputs.single(
        torch.sin(0.1 * torch.arange(30).double())[:, None],
        torch.tensor([0.5, 0.0]).double(),
        action_names=("torque",),
        state_names=("hinge", "hinge_velocity"),
        time_step=simulator.time_step,
    )


def test_a_run_folder_holds_what_the_simulator_was_made_from(tmp_path):
    simulator = npdr.MujocoSimulator(
        robot(tmp_path / "mine"), {"damping": "joint hinge damping"}, time_step=0.02
    )
    given = inputs(simulator)

    def model(inputs):
        damping = pyro.sample("damping", dist.Uniform(0.0, 1.0))
        return npdr.simulate("trajectory", simulator, {"damping": damping}, inputs)

    readings = torch.cat((given.initial_values, simulator.simulate({}, given)[0]))
    rollouts = Rollouts.from_arrays(
        readings=[readings.numpy()], actions=[given.actions[0].numpy()],
        channel_names=given.channel_names, action_names=given.action_names, time_step=0.02,
    )  # fmt: skip
    npdr.infer(
        model, rollouts, backend="abc", num_simulations=200,
        options=npdr.DataOptions("all/10", None, "recorded"),
        seed=0, progress=False,
        checkpoint=tmp_path / "run",
    )  # fmt: skip
    (tmp_path / "mine" / "robot.xml").write_text("<mujoco/>")
    engine = json.loads((tmp_path / "run" / "run.json").read_text())["engines"]["trajectory"]
    assert engine["version"] == mujoco.__version__
    assert engine["parameters"] == {"damping": "joint hinge damping"}
    assert engine["mjcf"]["assets"] == {
        "hand.obj": hashlib.sha256(TETRAHEDRON.encode()).hexdigest()
    }
    again = robot(tmp_path / "again")
    for name, text in engine["mjcf"]["text"].items():
        (tmp_path / "again" / name).write_text(text)
    assert again.name == engine["mjcf"]["file"]
    twin = npdr.MujocoSimulator(again, engine["parameters"], time_step=engine["time_step"])
    damping = {"damping": torch.tensor([0.1, 0.9]).double()}
    assert torch.equal(twin.simulate(damping, given), simulator.simulate(damping, given))


def test_a_compiled_model_is_told_from_others():
    def digest(text):
        model = mujoco.MjModel.from_xml_string(text)
        return npdr.MujocoSimulator(model).recorded_settings()["mjcf"]["model_sha256"]

    assert digest(ARM) == digest(ARM)
    assert digest(ARM) != digest(ARM.replace("0.2", "0.3"))


def test_urdf_files_and_absent_assets(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(
        '<robot name="arm"><link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    simulator = BulletSimulator(file, sensors=(Sensor(Channel("x", "m"), "body robot x"),))
    assert simulator.recorded_settings()["urdf"]["text"] == {"arm.urdf": file.read_text()}
    file.write_text('<robot><mesh filename="gone.stl"/></robot>')
    assert recorded_files(file)["assets"] == {"gone.stl": None}
    file.write_text("no XML & neither closed")
    with pytest.raises(ModelError, match=r"arm\.urdf is not well-formed XML"):
        recorded_files(file)


@pytest.mark.parametrize(
    "text",
    [
        '<mujoco><include file="{}"/></mujoco>',
        '<mujoco><asset><model name="m" file="{}"/></asset></mujoco>',
        '<mujoco><worldbody><include xmlns="x" file="{}"/></worldbody></mujoco>',
    ],
)
@pytest.mark.parametrize("place", ["../secret.xml", "absolute", "link.xml"])
def test_files_outside_of_the_folder_are_not_included(text, place, tmp_path):
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "link.xml").symlink_to(tmp_path / "secret.xml")
    file = tmp_path / "robot" / "robot.xml"
    file.write_text(text.format(tmp_path / "secret.xml" if place == "absolute" else place))
    for read in (npdr.MujocoSimulator, recorded_files):
        with pytest.raises(ModelError, match=r"which is outside of its folder; copy it"):
            read(file)


def test_includes_of_urdf_and_meshes_elsewhere_are_not_recorded(tmp_path):
    (tmp_path / "secret.stl").write_text("solid secret")
    (tmp_path / "robot").mkdir()
    file = tmp_path / "robot" / "robot.urdf"
    file.write_text(
        '<robot name="r"><include file="../secret.stl"/><mesh filename="../secret.stl"/></robot>'
    )
    recorded = recorded_files(file)
    assert set(recorded["text"]) == {"robot.urdf"}
    assert recorded["assets"] == {"../secret.stl": OUTSIDE}
