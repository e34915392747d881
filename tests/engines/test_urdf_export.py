"""Identified values in a URDF file: it moves as the fitted model does, and stays physical."""

import re

import numpy as np
import pytest

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.urdf_export import export_urdf
from npdr_ppl.errors import ModelError
from npdr_ppl.models.effects import (
    CoulombFriction,
    OffsetPayload,
    Payload,
    StribeckFriction,
    ViscousFriction,
)
from tests.helpers.mujoco_files import ARM, random_inputs, value

ROBOT = """<?xml version="1.0"?>
<robot name="arm">
  <!-- kept -->
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0.01 0 -0.15" rpy="0.2 0.1 -0.3"/>
      <mass value="0.8"/>
      <inertia ixx="0.006" iyy="0.0061" izz="0.0004" ixy="0.0001" ixz="0" iyz="-0.0002"/>
    </inertial>
  </link>
  <link name="hand"><inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool">{tool}</link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping="0.1"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="hand"/>
    <origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/></joint>
  <joint name="flange" type="fixed"><parent link="hand"/><child link="tool"/></joint>
</robot>
"""

HEAVY = '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" '
HEAVY += 'iyz="0"/></inertial>'

FIELDS = {
    "upper": "body upper mass_and_inertia",
    "centre": "body upper centre x",
    "damping": "joint shoulder damping",
    "friction": "joint elbow frictionloss",
    "armature": "joint elbow armature",
    "inertia": "body hand inertia x",
}


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """The engine writes its own warnings to a file in the present folder."""
    monkeypatch.chdir(tmp_path)


def arm(folder, *names, tool=""):
    path = folder / "arm.urdf"
    path.write_text(ROBOT.format(tool=tool))
    return MujocoSimulator(path, {name: FIELDS[name] for name in names})


@pytest.mark.parametrize(
    ("payload", "values"),
    [
        (Payload("payload"), {"mass": 0.2}),
        (OffsetPayload("payload"), {"mass": 0.2, "y": 0.1, "z": -0.05}),
    ],
)
def test_a_urdf_file_moves_as_the_fitted_model(tmp_path, payload, values):
    simulator = arm(tmp_path, "upper", "centre", "damping", "friction").with_effects(
        ViscousFriction("elbow_torque"), payload
    )
    numbers = {
        "upper": 1.1,
        "centre": 0.03,
        "damping": 0.25,
        "friction": 0.02,
        "elbow_torque.viscous_friction.damping": 0.07,
    }
    numbers |= {f"{payload.name}.{name}": number for name, number in values.items()}
    given = {name: value(number) for name, number in numbers.items()}
    found = export_urdf(simulator, given)
    assert not found.refused and "<!-- kept -->" in found.text
    path = tmp_path / "identified.urdf"
    path.write_text(found.text)
    again = MujocoSimulator(path)
    inputs = random_inputs(simulator, num_steps=100)
    wanted = simulator.simulate(given, inputs)
    assert float((wanted - again.simulate({}, inputs)).abs().max()) < 1e-6
    plain = MujocoSimulator(tmp_path / "arm.urdf")
    assert float((wanted - plain.simulate({}, inputs)).abs().max()) > 1e-2


def test_only_what_changes_is_written(tmp_path):
    found = export_urdf(arm(tmp_path, "damping", "friction"), {"damping": value(0.4)})
    new = [line for line in found.text.splitlines() if line not in found.before.splitlines()]
    assert len(new) == 1
    assert '<!-- npdr: damping 0.4 (was 0.1) --> <dynamics damping="0.4"/>' in new[0]


def test_values_that_stay_change_nothing(tmp_path):
    simulator = arm(tmp_path, "upper", "damping")
    mass = float(simulator.model.body("upper").mass[0])
    found = export_urdf(simulator, {"upper": value(mass), "damping": value(0.1)})
    assert found.text == found.before


def test_inertias_stay_physical(tmp_path):
    path = tmp_path / "new.urdf"
    for number in (0.2, 0.8, 3.0):
        path.write_text(export_urdf(arm(tmp_path, "upper"), {"upper": value(number)}).text)
        model = load_mjcf(path)
        largest = model.body_inertia.max(axis=1)
        assert np.all(2.0 * largest <= model.body_inertia.sum(axis=1) * (1.0 + 1e-9))
    # The largest moment of inertia is at most the sum of the others.
    with pytest.raises(ModelError, match="inertia"):
        export_urdf(arm(tmp_path, "inertia"), {"inertia": value(0.005)})


def test_effects_without_a_place_are_refused(tmp_path):
    simulator = arm(tmp_path).with_effects(
        CoulombFriction("elbow_torque"), StribeckFriction("elbow_torque")
    )
    given = {"elbow_torque.coulomb_friction.magnitude": value(0.1)}
    found = export_urdf(simulator, given)
    assert list(found.refused) == ["elbow_torque.stribeck_friction"]
    assert '<dynamics friction="0.1"/>' in found.text


@pytest.mark.parametrize(
    ("name", "tool", "sentence"),
    [
        ("upper", "", ""),
        ("inertia", HEAVY, "Link hand is welded to tool"),
    ],
)
def test_what_a_urdf_file_cannot_hold_is_said(tmp_path, name, tool, sentence):
    simulator = arm(tmp_path, name, tool=tool)
    if not sentence:
        assert export_urdf(simulator, {name: value(0.9)}).text
        return
    with pytest.raises(ModelError, match=re.escape(sentence)):
        export_urdf(simulator, {name: value(0.0011)})


def test_armatures_are_left_out_of_a_urdf_file_and_listed(tmp_path):
    simulator = arm(tmp_path, "armature", "damping")
    found = export_urdf(simulator, {"armature": value(0.0125), "damping": value(0.4)})
    assert 'damping="0.4"' in found.text
    ((name, reason),) = found.refused.items()
    assert name.startswith("armature of ") and ", 0.0125 kg m²" in name
    assert reason.startswith("a URDF file has no place for it")


def test_an_mjcf_file_does_not_become_a_urdf_file(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(integrator="Euler", friction=0, solver=""))
    with pytest.raises(ModelError, match="not made from a URDF file"):
        export_urdf(MujocoSimulator(path), {})
