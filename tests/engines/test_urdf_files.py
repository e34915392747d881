"""URDF files as they usually are: meshes elsewhere, joints that mimic others, odd efforts."""

import math
import os

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.common.source_files import recorded_files
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.derived_model import derive_model
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.errors import ModelError

INERTIAL = (
    '<inertial><origin xyz="0 0 -0.5"/><mass value="1.23456789"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def urdf(shape="", *, effort="7", inertial=INERTIAL, joint="hinge", more=""):
    """Returns a pendulum as URDF text."""
    return f"""<robot name="lever"><link name="base"/><link name="rod">{inertial}{shape}</link>
    <joint name="{joint}" type="revolute"><parent link="base"/><child link="rod"/>
    <axis xyz="0 1 0"/><limit effort="{effort}" lower="-2" upper="2" velocity="9"/></joint>
    {more}</robot>"""


def mesh(name):
    return f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'


def tetrahedron():
    """Returns an STL file's bytes."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype="<f4")
    faces = np.zeros(4, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("end", "<u2")])
    faces["corners"] = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    return bytes(80) + len(faces).to_bytes(4, "little") + faces.tobytes()


def written(folder, text):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("lever/urdf/x.stl", "package://lever/meshes/x.stl"),
        ("lever/urdf/x.stl", "x.stl"),
        ("lever/meshes/x.stl", "package://lever/meshes/x.stl"),
        ("lever/meshes/x.stl", "../meshes/x.stl"),
        ("lever/urdf/other/x.stl", "package://other/x.stl"),
    ],
)
def test_meshes_are_found_in_the_package_and_beside_the_file(tmp_path, place, name):
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).write_bytes(tetrahedron())
    path = written(tmp_path / "lever" / "urdf", urdf(mesh(name)))
    assert load_mjcf(path).ngeom == 1
    (digest,) = recorded_files(path)["assets"].values()
    assert digest is not None


def test_meshes_that_are_nowhere_are_left_out_with_a_warning(tmp_path, caplog):
    names = ["package://lever/lost.stl", "page.dae", "x" * 5000 + ".stl"]
    (tmp_path / "page.dae").write_text("<COLLADA/>")
    model = load_mjcf(written(tmp_path, urdf("".join(map(mesh, names)))))
    assert model.ngeom == 0
    assert all(name in caplog.text for name in names)
    load_mjcf(written(tmp_path, urdf("".join(map(mesh, names)))))
    assert len(caplog.records) == 1
    # Without <inertial>, the link's mass would follow from the mesh.
    with pytest.raises(ModelError, match=r"link rod has no <inertial>, and its mesh lost.stl"):
        load_mjcf(written(tmp_path, urdf(mesh("lost.stl"), inertial="")))


def test_a_warning_of_many_missing_meshes_is_short(tmp_path, caplog):
    load_mjcf(written(tmp_path, urdf("".join(mesh(f"lost_{k}.stl") for k in range(7)))))
    assert "lost_0.stl, lost_1.stl, lost_2.stl and 4 more." in caplog.text


def test_a_mesh_that_is_too_large_is_refused_wherever_it_is_found(tmp_path):
    with (tmp_path / "large.obj").open("wb") as file:
        os.truncate(file.fileno(), 600_000_000)
    path = written(tmp_path, urdf(mesh("package://lever/large.obj")))
    with pytest.raises(ModelError, match=r"large\.obj has more than"):
        load_mjcf(path)


def test_a_file_that_does_not_exist(tmp_path):
    with pytest.raises(ModelError, match=r"none\.urdf"):
        load_mjcf(tmp_path / "none.urdf")


def test_joints_that_mimic_others_and_joints_without_a_name(tmp_path):
    other = (
        f'<link name="{{0}}">{INERTIAL}</link><joint name="{{1}}" type="continuous">'
        '<parent link="rod"/><child link="{0}"/><axis xyz="0 1 0"/>{2}</joint>'
    )
    more = other.format("tip", "mirror", '<mimic joint="hinge"/>') + other.format("end", "", "")
    simulator = npdr.MujocoSimulator(written(tmp_path, urdf(more=more)), {})
    assert [a.name for a in simulator.actions] == ["hinge_motor", "joint_2_motor"]
    assert [a.upper for a in simulator.actions] == [7.0, math.inf]


@pytest.mark.parametrize("effort", ["0", "7", "1e9", "inf"])
def test_an_effort_that_is_a_placeholder_gives_no_wide_prior(tmp_path, effort):
    found = derive_model(written(tmp_path, urdf(effort=effort)))
    (armature,) = (p for p in found.parameters if p.name == "hinge_armature")
    inertia = 0.1 + 1.23456789 * 0.25
    assert (armature.nominal, armature.low) == (0.0, 0.0)
    assert armature.high == pytest.approx(10.0 * inertia, rel=1e-6)


def test_a_light_link_behind_a_strong_motor_gets_a_wider_prior(tmp_path):
    light = (
        INERTIAL.replace("1.23456789", "0.001").replace('"0.1"', '"1e-4"').replace("1e-3", "1e-5")
    )
    tip = (
        f'<link name="tip">{light}</link><joint name="wrist" type="revolute"><parent link="rod"/>'
        '<child link="tip"/><axis xyz="0 1 0"/><limit effort="50" lower="-2" upper="2" '
        'velocity="9"/></joint>'
    )
    found = derive_model(written(tmp_path, urdf(more=tip)))
    (wrist,) = (p for p in found.parameters if p.name == "wrist_armature")
    assert wrist.high == pytest.approx(10.0 * 50.0 / 500.0)


def test_the_mjcf_file_of_a_urdf_run_has_its_motors_and_meshes(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "x.stl").write_bytes(tetrahedron())
    path = written(tmp_path / "urdf", urdf(mesh("../meshes/x.stl")))
    simulator = npdr.MujocoSimulator(path, {"armature": "joint hinge armature"})
    found = export_mjcf(simulator, {"armature": torch.tensor(0.25)})
    assert found.needs_folder and 'file="../meshes/x.stl"' in found.text
    new = path.with_name("new.xml")
    new.write_text(found.text)
    model = load_mjcf(new)
    assert (model.nu, model.ngeom, float(model.dof_armature[0])) == (1, 1, 0.25)
    assert model.actuator_ctrlrange.tolist() == [[-7.0, 7.0]]
    assert float(model.body_mass[1]) == pytest.approx(1.23456789, rel=1e-5)
