"""A model derived from an MJCF or URDF file: which numbers it varies, and that it simulates."""

import math
import re

import mujoco
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco import Scale
from npdr_ppl.engines.mujoco.derived_model import derive_model
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ViscousFriction

ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="stand"><geom type="box" size="0.1 0.1 0.1" pos="0 0 -1" mass="5"/>
      <body name="upper">
        <joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8"/>
        <body name="hand" pos="0 0 -0.3">
          <joint name="elbow" axis="0 1 0" frictionloss="0.05"/>
          <geom type="sphere" pos="0 0 -0.2" size="0.03" mass="0.3"/>
          <body name="tip" pos="0 0 -0.2"><geom type="sphere" size="0.001" mass="1e-5"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_servo" joint="shoulder" kp="40" kv="2" ctrlrange="-2 2"/>
    <velocity joint="elbow" kv="0.5"/>
    <motor name="motor" joint="elbow" gear="2"/>
  </actuator>
</mujoco>
"""

LEVER = """
<robot name="lever">
  <link name="base"/>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/><mass value="1.0"/>
      <inertia ixx="0.0833" iyy="0.0833" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="rod"/><axis xyz="0 1 0"/><dynamics damping="0.1"/>
  </joint>
</robot>
"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def loaded(source):
    """Returns what a derived Python file defines."""
    names: dict[str, object] = {}
    exec(source, names)
    return names


def inputs(simulator, num_steps=40):
    return Inputs.single(
        torch.full((num_steps, len(simulator.actions)), 0.4, dtype=torch.float64),
        torch.full((len(simulator.states),), 0.1, dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    )


def gains(value):
    """Quantiles between which 95 % of a gain's prior are."""
    prior = dist.LogNormal(math.log(value), 1.5)
    return [float(prior.icdf(torch.tensor(share))) for share in (0.025, 0.975)]


def test_moving_masses_positive_friction_and_gains_are_varied(arm):
    derived = derive_model(arm)
    found = {p.name: (p.field, p.unit, p.nominal, p.low, p.high) for p in derived.parameters}
    expected = {
        "upper_mass": ("body upper mass_and_inertia", "kg", 0.8, 0.56, 1.04),
        "hand_mass": ("body hand mass_and_inertia", "kg", 0.3, 0.21, 0.39),
        "elbow_frictionloss": ("joint elbow frictionloss", "N m", 0.05, 0.0, 0.5),
        "shoulder_armature": ("joint shoulder armature", "kg m²", 0.02, 0.01, 0.03),
        "shoulder_servo_kp": ("actuator shoulder_servo kp", "N m/rad", 40.0, *gains(40.0)),
        "shoulder_servo_kv": ("actuator shoulder_servo kv", "N m s/rad", 2.0, *gains(2.0)),
        "elbow_command_kv": ("actuator elbow_command kv", "N m s/rad", 0.5, *gains(0.5)),
        "friction_softness": ("joint * friction_softness", "1", 0.1, 0.0001, 0.1),
    }
    # The stand does not move, the tip weighs nothing, and damping acts as kv does.
    assert list(found) == list(expected)
    for name, (field, unit, *numbers) in expected.items():
        assert found[name][:2] == (field, unit)
        assert found[name][2:] == pytest.approx(tuple(numbers), rel=1e-3)
    assert derived.held == {"joint shoulder damping": ("actuator shoulder_servo kv",)}
    assert derived.reason("joint shoulder damping") == "same effect as actuator shoulder_servo kv"


def test_the_larger_of_damping_and_kv_is_varied(arm):
    arm.write_text(ARM.replace('damping="0.3"', 'damping="30"'))
    derived = derive_model(arm)
    assert derived.held == {"actuator shoulder_servo kv": ("joint shoulder damping",)}
    assert "shoulder_damping" in [p.name for p in derived.parameters]


def test_the_python_simulates_as_an_edited_file_does(arm):
    scope = loaded(derive_model(arm).source(arm))
    robot = scope["robot"]
    assert isinstance(robot, npdr.MujocoSimulator)
    given = inputs(robot)
    trace = pyro.poutine.trace(scope["model"]).get_trace(given)
    priors = {name: trace.nodes[name]["fn"] for name in scope["PRIORS"]}
    assert isinstance(priors["shoulder_servo_kp"], dist.LogNormal)
    assert isinstance(priors["upper_mass"], dist.Uniform)
    assert set(priors) == {p.name for p in robot.parameters}
    assert robot.corrected_number(ViscousFriction("shoulder_torque")) == "joint shoulder damping"
    values = {name: trace.nodes[name]["value"].double() for name in priors}
    # The same changes, made in the text of the file.
    spec = mujoco.MjSpec.from_file(str(arm))
    compiled = spec.compile()
    for body in ("upper", "hand"):
        factor = float(values[f"{body}_mass"]) / compiled.body(body).mass[0]
        compiled.body(body).mass[:] *= factor
        compiled.body(body).inertia[:] *= factor
    compiled.joint("elbow").frictionloss[:] = float(values["elbow_frictionloss"])
    softness = float(values["friction_softness"])
    least = 2.0 * compiled.opt.timestep
    compiled.dof_solimp[:, 0] = 1.0 - softness
    compiled.dof_solref[:, 0] = least + (0.02 - least) * softness / 0.1
    compiled.joint("shoulder").armature[:] = float(values["shoulder_armature"])
    kp, kv = float(values["shoulder_servo_kp"]), float(values["shoulder_servo_kv"])
    compiled.actuator_gainprm[0, 0] = kp
    compiled.actuator_biasprm[0, :3] = 0.0, -kp, -kv
    own = float(values["elbow_command_kv"])
    compiled.actuator_gainprm[1, 0], compiled.actuator_biasprm[1, 2] = own, -own
    mujoco.mj_setConst(compiled, mujoco.MjData(compiled))
    edited = npdr.MujocoSimulator(compiled).simulate({}, given)
    torch.testing.assert_close(trace.nodes["trajectory"]["value"].double(), edited)


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ("actuator motor kv", "only position and velocity servos have a kv"),
        ("actuator elbow_command kp", "only position servos have a kp"),
        ("body world mass_and_inertia", "the body has no mass"),
    ],
)
def test_a_field_that_an_element_does_not_have(arm, field, sentence):
    with pytest.raises(ModelError, match=sentence):
        npdr.MujocoSimulator(arm, {"x": field})


def test_names_of_the_file_stay_in_strings_of_the_python(tmp_path):
    path = tmp_path / "robot.xml"
    shown = "a&quot;&quot;&quot; # \\ 9 &apos;"
    path.write_text(
        f'<mujoco><worldbody><body name="9"><joint name="{shown}" damping="1"/>'
        '<geom size="0.1"/></body></worldbody>'
        f'<actuator><position name="{shown}" joint="{shown}" kp="9" kv="9"/></actuator></mujoco>'
    )
    derived = derive_model(path)
    assert derived.held
    scope = loaded(derived.source(path))
    assert [p.name for p in derived.parameters] == list(scope["PRIORS"])
    assert all(p.name.isidentifier() for p in derived.parameters)


def test_a_urdf_file_gets_motors(tmp_path):
    path = tmp_path / "lever.urdf"
    path.write_text(LEVER)
    scope = loaded(derive_model(path).source(path))
    assert list(scope["PRIORS"]) == ["rod_mass", "hinge_damping", "hinge_armature"]
    # The rod's inertia about the hinge.
    armature = scope["PRIORS"]["hinge_armature"]
    assert (armature.low, armature.high) == pytest.approx((0.0, 10 * 0.3333), rel=1e-3)
    assert "math" not in scope
    robot = scope["robot"]
    assert [(a.name, a.unit, a.lower, a.upper) for a in robot.actions] == [
        ("hinge_motor", "N m", -math.inf, math.inf)
    ]
    moved = robot.simulate({"hinge_damping": torch.tensor([0.1, 0.2])}, inputs(robot))
    assert float((moved[0] - moved[1]).abs().max()) > 1e-4


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "has no joints"),
        ("<sdf/>", "is not a readable MJCF file"),
        (ARM.replace('kp="40"', 'kp="40" timeconst="0.1"'), "states of their own"),
    ],
)
def test_files_without_a_model(tmp_path, text, sentence):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(ModelError, match=sentence):
        derive_model(path)


def test_a_light_body_is_varied_where_it_is_a_joints_whole_load(tmp_path):
    path = tmp_path / "gripper.xml"
    path.write_text(
        "<mujoco><worldbody><body name='base'><joint name='turn'/><geom size='0.1' mass='50'/>"
        "<body name='finger'><joint name='slide' type='slide'/><geom size='0.01' mass='0.01'/>"
        "</body></body></worldbody><actuator><motor joint='turn'/><motor joint='slide'/>"
        "</actuator></mujoco>"
    )
    assert [p.name for p in derive_model(path).parameters] == ["base_mass", "finger_mass"]


def test_positions_behind_servos_determine_masses_and_gains_up_to_a_factor(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(re.sub("<(motor|velocity).*/>", "", ARM))
    derived = derive_model(path)
    assert set(derived.held) == {"joint shoulder damping", "body upper mass_and_inertia"}
    # The same factor on all others moves the arm as the same factor on the mass that is held.
    robot = npdr.MujocoSimulator(
        path, {"all": Scale(*(p.field for p in derived.parameters), *derived.held)}
    )
    found = robot.simulate({"all": torch.tensor([1.0, 1.25])}, inputs(robot))
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-6)


def test_a_vertical_link_and_its_rotor_are_one_inertia(tmp_path):
    path = tmp_path / "turntable.xml"
    path.write_text(
        "<mujoco><worldbody><body name='table'><joint name='turn' armature='0.1'/>"
        "<geom size='0.1' mass='5'/></body></worldbody>"
        "<actuator><motor joint='turn'/></actuator></mujoco>"
    )
    derived = derive_model(path)
    assert derived.held == {"body table mass_and_inertia": ("joint turn armature",)}


def test_small_friction_beside_a_stiff_servo_has_an_effect(tmp_path):
    path = tmp_path / "servo.xml"
    path.write_text(
        "<mujoco><worldbody><body name='link'><joint name='j' axis='0 1 0' frictionloss='0.05'/>"
        "<geom size='0.05' pos='0 0 -0.1' mass='0.1'/></body></worldbody>"
        "<actuator><position joint='j' kp='1000' kv='3'/></actuator></mujoco>"
    )
    derived = derive_model(path)
    names = [p.name for p in derived.parameters]
    assert names == ["j_frictionloss", "j_command_kp", "j_command_kv", "friction_softness"]
    assert list(derived.held) == ["body link mass_and_inertia"]


def test_the_softness_of_friction_is_that_of_joints_with_friction(tmp_path):
    path = tmp_path / "floating.xml"
    path.write_text(
        "<mujoco><worldbody><body name='base'><freejoint name='root'/><geom size='0.1'/>"
        "<body name='link'><joint name='knee' axis='0 1 0' frictionloss='0.05'/>"
        "<geom size='0.05' pos='0 0 -0.1'/><body><joint axis='1 0 0'/><geom size='0.05'/></body>"
        "</body></body></worldbody></mujoco>"
    )
    robot = loaded(derive_model(path).source(path))["robot"]
    assert {place for array, place in robot.bindings.places if array == "dof_solimp"} == {30}
    exported = export_mjcf(robot, {"friction_softness": torch.tensor(0.001)})
    for attribute in ("solimpfriction", "solreffriction"):
        assert exported.text.count(attribute) == 2  # the attribute and the comment


def test_friction_whose_hardness_the_file_sets_keeps_it(arm):
    softened = 'frictionloss="0.05" solimpfriction="0.99 0.99"'
    arm.write_text(ARM.replace('frictionloss="0.05"', softened))
    derived = derive_model(arm)
    names = [p.name for p in derived.parameters]
    assert "elbow_frictionloss" in names and "friction_softness" not in names
    arm.write_text(ARM.replace('frictionloss="0.05"', ""))
    assert "friction_softness" not in [p.name for p in derive_model(arm).parameters]


def test_gains_of_a_tendons_servo_have_no_unit_of_force(tmp_path):
    path = tmp_path / "gripper.xml"
    path.write_text(
        "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='0.1'/></body>"
        "</worldbody><tendon><fixed name='t'><joint joint='j' coef='1'/></fixed></tendon>"
        "<actuator><position name='grip' tendon='t' kp='9' kv='2'/></actuator></mujoco>"
    )
    assert {p.name: p.unit for p in derive_model(path).parameters} == {
        "grip_kp": "1",
        "grip_kv": "s",
    }
