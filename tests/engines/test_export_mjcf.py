"""Identified parameters and effects in an MJCF file: the file moves as the fitted model does."""

import re

import mujoco
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText
from npdr_ppl.errors import ModelError
from npdr_ppl.models.effects import (
    Backlash,
    Bias,
    Contact,
    CoulombFriction,
    EncoderBias,
    InputDelay,
    OffsetPayload,
    ParameterDrift,
    Payload,
    Saturation,
    ServoGain,
    Spring,
    Tilt,
    ViscousFriction,
)
from tests.helpers.mujoco_files import ARM, GYMNASIUM, needs_gymnasium, random_inputs, value

SERVOS = """<mujoco>
  <!-- kept -->
  <default>
    <default class="servo"><joint damping="0.6" frictionloss="0.05"/>
      <position kp="20" kv="0.5" forcerange="-3 3"/></default>
  </default>
  <include file="parts/links.xml"/>
  <actuator>
    <position class="servo" name="one" joint="a"/>
    <velocity name="two" joint="b" kv="0.4"/>
    <general name="three" joint="c" gainprm="2" biastype="affine" biasprm="0 -2 -0.1"/>
  </actuator>
</mujoco>
"""

LINKS = """<mujocoinclude>
  <worldbody>
    <body name="base">
      <joint class="servo" name="a" axis="0 1 0"/>
      <geom name="rod" size="0.02" type="capsule" fromto="0 0 0 0.3 0 0"/>
      <body name="middle" pos="0.3 0 0">
        <joint name="b" axis="0 1 0" range="-90 90"/>
        <inertial pos="0.1 0 0.01" mass="0.4" fullinertia="0.01 0.02 0.02 0.001 0 0"/>
        <body name="tip" pos="0.2 0 0">
          <joint name="c" axis="0 0 1"/>
          <geom size="0.05"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujocoinclude>
"""


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """The engine writes its own warnings to a file in the present folder."""
    monkeypatch.chdir(tmp_path)


def write_arm(folder, integrator="Euler"):
    path = folder / "arm.xml"
    path.write_text(ARM.format(integrator=integrator, friction=0.0, solver=""))
    return path


def write_servos(folder):
    (folder / "parts").mkdir()
    (folder / "parts" / "links.xml").write_text(LINKS)
    path = folder / "servos.xml"
    path.write_text(SERVOS)
    return path


def largest_difference(simulator, values):
    """Between the fitted model and the reloaded file over 1 s, and how much the values change."""
    given = {name: value(number) for name, number in values.items()}
    found = export_mjcf(simulator, given)
    assert not found.refused
    path = simulator.file.with_name("identified.xml")
    path.write_text(found.text)
    again = MujocoSimulator(path, time_step=simulator.time_step)
    assert again.num_substeps(again.time_step) == simulator.num_substeps(simulator.time_step)
    inputs = random_inputs(simulator, num_steps=round(1.0 / simulator.time_step))
    wanted = simulator.simulate(given, inputs)
    plain = MujocoSimulator(simulator.file, time_step=simulator.time_step)
    effect = (wanted - plain.simulate({}, inputs)).abs().max()
    return float((wanted - again.simulate({}, inputs)).abs().max()), float(effect)


class Own(Bias):
    """An effect of a user, whose law cannot be followed."""

    id = "own"

    def force(self, position, velocity, parameters, memory):
        """Takes a number out of torch."""
        return parameters["offset"] * float(position)


def test_a_refused_law_does_not_decide_where_dry_friction_goes(tmp_path):
    """Beside a law that reads accelerations, simulations apply dry friction themselves."""

    class OwnWithJoint(Own):
        needs_joint = True

    own, dry = OwnWithJoint("shoulder_torque"), CoulombFriction("elbow_torque")
    simulator = MujocoSimulator(write_arm(tmp_path, "Euler")).with_effects(own, dry)
    given = {f"{own.name}.offset": value(0.1), f"{dry.name}.magnitude": value(0.2)}
    found = export_mjcf(simulator, given)
    assert set(found.refused) == {own.name} and found.callbacks is None
    assert found.text.count('frictionloss="0.2"') == 1


EFFECTS = [
    (CoulombFriction("elbow_torque"), {"magnitude": 0.2}),
    (ViscousFriction("elbow_torque"), {"damping": 0.2}),
    (Spring("shoulder_torque"), {"stiffness": 2.0, "rest": 0.3}),
    (Payload("payload"), {"mass": 0.2}),
    (OffsetPayload("payload"), {"mass": 0.2, "x": 0.1, "y": -0.05, "z": 0.02}),
    (Tilt("gravity"), {"roll": 0.02, "pitch": -0.05}),
    (ServoGain("elbow_command"), {"error": 0.3}),
    (Saturation("motor"), {"limit": 1.5}),
]


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize(("effect", "values"), EFFECTS, ids=[e.id for e, _ in EFFECTS])
def test_an_effect_in_the_file_moves_the_robot_as_in_the_model(
    tmp_path, effect, values, integrator
):
    simulator = MujocoSimulator(write_arm(tmp_path, integrator)).with_effects(effect)
    given = {f"{effect.name}.{name}": number for name, number in values.items()}
    difference, matters = largest_difference(simulator, given)
    assert difference <= 1e-6 and matters > 1e-3


ADDRESSES = {
    "mass": ("body hand mass_and_inertia", 0.3),
    "centre": ("body hand centre z", -0.15),
    "damping": ("joint shoulder damping", 0.5),
    "friction": ("joint elbow frictionloss", 0.1),
    "softness": ("joint elbow friction_softness", 0.001),
    "armature": ("joint elbow armature", 0.03),
    "stiffness": ("joint elbow stiffness", 1.5),
    "rest": ("joint elbow rest", 0.2),
    "kp": ("actuator elbow_command kp", 6.0),
    "gear": ("actuator motor gear", 2.5),
    "weight": ("option gravity z", -9.7),
}


def test_parameters_of_every_kind_are_written(tmp_path):
    addresses = {name: address for name, (address, _) in ADDRESSES.items()}
    simulator = MujocoSimulator(write_arm(tmp_path), addresses)
    difference, matters = largest_difference(
        simulator, {name: number for name, (_, number) in ADDRESSES.items()}
    )
    assert difference == 0.0 and matters > 1e-3


def test_only_the_softness_of_friction_is_written(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(integrator="Euler", friction=0.2, solver=""))
    simulator = MujocoSimulator(path, {"softness": "joint * friction_softness"})
    difference, matters = largest_difference(simulator, {"softness": 0.001})
    assert difference == 0.0 and matters > 1e-3
    assert (tmp_path / "identified.xml").read_text().count("solimpfriction") == 2
    beyond = export_mjcf(simulator, {"softness": value(1.2)})
    assert 'solimpfriction="0.0001 ' in beyond.text  # what the engine takes instead


def test_servos_defaults_and_includes(tmp_path):
    addresses = {
        "kp": "actuator one kp",
        "kv": "actuator two kv",
        "gain": "actuator three kp",
        "mass": "body middle mass",
        "tip": "body tip mass_and_inertia",
        "damping": "joint a damping",
    }
    simulator = MujocoSimulator(write_servos(tmp_path), addresses)
    values = {"kp": 25.0, "kv": 0.6, "gain": 3.0, "mass": 0.5, "tip": 0.3, "damping": 0.9}
    difference, matters = largest_difference(simulator, values)
    assert difference <= 1e-9 and matters > 1e-3


def test_finer_steps_are_written(tmp_path):
    simulator = MujocoSimulator(write_arm(tmp_path), {"mass": "body hand mass_and_inertia"})
    finer = simulator.with_finer_steps().with_finer_steps()
    difference, _ = largest_difference(finer, {"mass": 0.25})
    assert difference == 0.0
    text = (tmp_path / "identified.xml").read_text()
    assert 'integrator="RK4"' in text and 'timestep="0.001"' in text


@needs_gymnasium
@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "ant", "walker2d", "swimmer"])
def test_files_of_others(tmp_path, name):
    path = tmp_path / f"{name}.xml"
    path.write_text((GYMNASIUM / f"{name}.xml").read_text())
    joint = MujocoSimulator(path).joints[-1]
    own = joint.removesuffix("_torque").removesuffix("_force")
    simulator = MujocoSimulator(path, {"damping": f"joint {own} damping"})
    effect = CoulombFriction(joint)
    difference, matters = largest_difference(
        simulator.with_effects(effect), {"damping": 0.7, f"{effect.name}.magnitude": 0.3}
    )
    assert difference <= 1e-6 and matters > 1e-3


def test_a_urdf_becomes_an_mjcf_file(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><link name="base"/><link name="rod"><inertial><mass value="1"/>'
        '<origin xyz="0.2 0 0"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="hinge" type="continuous"><parent link="base"/>'
        '<child link="rod"/><axis xyz="0 1 0"/><dynamics damping="0.1"/></joint></robot>'
    )
    simulator = MujocoSimulator(path, {"damping": "joint hinge damping"})
    difference, matters = largest_difference(simulator, {"damping": 0.4})
    assert difference <= 1e-6 and matters > 1e-3


def test_what_neither_file_nor_python_can_hold_is_listed(tmp_path):
    simulator = MujocoSimulator(write_arm(tmp_path), {"mass": "body hand mass"}).with_effects(
        Backlash("elbow_torque"), EncoderBias("elbow"), Own("elbow_torque"), ParameterDrift("mass")
    )
    given = {
        f"{e.name}.{n}": value(number)
        for e in simulator.effects
        for n, number in e.probe(simulator.port(e.port)).items()
    }
    found = export_mjcf(simulator, given)
    assert found.callbacks is not None
    assert found.callbacks.effects == ("elbow_torque.backlash", "elbow.encoder_bias")
    assert list(found.refused) == ["elbow_torque.own", "mass.parameter_drift"]
    assert found.refused["elbow_torque.own"].startswith("its law cannot be followed")
    assert "over minutes" in found.refused["mass.parameter_drift"]


def test_all_other_text_stays(tmp_path):
    simulator = MujocoSimulator(write_servos(tmp_path), {"damping": "joint a damping"})
    found = export_mjcf(simulator, {"damping": value(0.75)})
    new = [line for line in found.text.splitlines() if line not in found.before.splitlines()]
    assert [line.strip() for line in new] == [
        "<!-- npdr: damping 0.75 (was 0.6) -->",
        '<joint class="servo" name="a" axis="0 1 0" damping="0.75"/>',
    ]
    assert "<!-- kept -->" in found.text and "include" not in found.text


@pytest.mark.parametrize(
    ("old", "new", "address", "sentence"),
    [
        (' name="elbow" axis', " axis", "joint joint_1 damping", "no joint called 'joint_1'"),
        ("<compiler", '<compiler inertiafromgeom="true"', "body hand mass", "inertiafromgeom"),
        ("", "", "actuator motor gain", "make its gear"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, old, new, address, sentence):
    path = write_arm(tmp_path)
    # Nothing may refer to a joint without a name.
    servo = '<position joint="elbow" kp="4" ctrlrange="-1 1"/>'
    text = path.read_text().replace(servo, "")
    path.write_text(text.replace(old, new, 1) if old else text)
    simulator = MujocoSimulator(path, {"it": address})
    with pytest.raises(ModelError, match=re.escape(sentence)):
        export_mjcf(simulator, {"it": value(1.5)})


SETTINGS = """<mujoco><default><position kp="20" {default}/></default><worldbody>
  <body name="b"><joint name="j" axis="0 1 0" {joint}/>
    <geom name="g" type="sphere" size="0.1" mass="0.4"/></body>
  {frame}</worldbody>
  <actuator><position name="servo" joint="j" {servo}/></actuator></mujoco>"""


def write_robot(folder, **settings):
    path = folder / "robot.xml"
    nothing = dict.fromkeys(("default", "joint", "frame", "servo"), "")
    path.write_text(SETTINGS.format(**nothing | settings))
    return path


@pytest.mark.parametrize(
    ("settings", "address", "array"),
    [
        ({"default": 'dampratio="1"'}, "actuator servo kp", "biasprm"),
        ({"joint": 'springdamper="0.1 1"'}, "body b mass_and_inertia", "stiffness"),
        (
            {"frame": '<frame pos="0 0 1"><body name="c"><geom size="0.1"/></body></frame>'},
            "body c position x",
            "body_pos",
        ),
    ],
)
def test_settings_that_replace_a_value_are_noticed(tmp_path, settings, address, array):
    path = write_robot(tmp_path, **settings)
    with pytest.raises(ModelError, match=f"{array} would differ"):
        export_mjcf(MujocoSimulator(path, {"it": address}), {"it": value(0.3)})


def test_a_damping_ratio_is_replaced_by_the_damping(tmp_path):
    path = write_robot(tmp_path, servo='dampratio="1"')
    simulator = MujocoSimulator(path, {"mass": "body b mass_and_inertia"})
    difference, _ = largest_difference(simulator, {"mass": 0.7})
    assert difference == 0.0


def test_springs_and_dampers_of_higher_order_stay(tmp_path):
    joint = 'stiffness="0 5" springref="20" damping="0.1 0.2"'
    base = MujocoSimulator(write_robot(tmp_path, joint=joint))
    inputs = random_inputs(base)
    sprung = base.with_effects(Spring("j_torque"))
    zero = {"j_torque.spring.stiffness": value(0.0), "j_torque.spring.rest": value(0.3)}
    assert torch.equal(sprung.simulate(zero, inputs), base.simulate({}, inputs))
    damped = base.with_effects(ViscousFriction("j_torque"))
    difference, matters = largest_difference(damped, {"j_torque.viscous_friction.damping": 0.3})
    assert difference == 0.0 and matters > 1e-3


@pytest.mark.parametrize(("flag", "effect"), [("damper", ViscousFriction), ("spring", Spring)])
def test_effects_act_where_the_engine_has_switched_its_own_law_off(tmp_path, flag, effect):
    path = write_robot(tmp_path)
    option = f'<option><flag {flag}="disable"/></option><default>'
    path.write_text(path.read_text().replace("<default>", option))
    base = MujocoSimulator(path)
    attached = effect("j_torque")
    changed = base.with_effects(attached)
    inputs = random_inputs(base)
    probe = attached.probe(base.port("j_torque"))
    given = {f"{attached.name}.{name}": value(number) for name, number in probe.items()}
    assert not torch.equal(changed.simulate(given, inputs), base.simulate({}, inputs))
    found = export_mjcf(changed, given)
    assert found.callbacks is not None and found.callbacks.effects == (attached.name,)


def test_an_effect_that_cannot_be_written_leaves_the_others(tmp_path):
    path = write_arm(tmp_path)
    path.write_text(path.read_text().replace(' contype="0" conaffinity="0"', ""))
    simulator = MujocoSimulator(path).with_effects(Contact("contact"), Payload("payload"))
    given = {"contact.contact.friction": value(0.2), "payload.payload.mass": value(0.1)}
    found = export_mjcf(simulator, given)
    assert list(found.refused) == ["contact.contact"]
    assert "no geom called" in found.refused["contact.contact"]
    assert "npdr: mass" in found.text


def test_the_step_is_that_of_the_recording(tmp_path):
    simulator = MujocoSimulator(write_arm(tmp_path))  # 2 ms
    assert 'timestep="0.0015"' in export_mjcf(simulator, {}, time_step=0.003).text


def test_an_effect_is_attached_to_one_servo(tmp_path):
    simulator = MujocoSimulator(write_servos(tmp_path))
    with pytest.raises(ModelError, match="attach it to each of one,two"):
        simulator.with_effects(ServoGain("one,two"))
    assert simulator.with_effects(InputDelay("one,two")).effects


def test_a_compiled_model_has_no_file():
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="RK4", friction=0, solver=""))
    with pytest.raises(ModelError, match="it has no file"):
        export_mjcf(MujocoSimulator(model), {})


def test_an_inertia_that_no_body_has_is_refused(tmp_path):
    simulator = MujocoSimulator(write_arm(tmp_path), {"it": "body hand inertia x"})
    with pytest.raises(ModelError, match="inertia"):
        export_mjcf(simulator, {"it": value(0.5)})


def test_attributes_are_found_in_any_layout():
    text = b"<mujoco><worldbody>\n<body name='a>b'><joint\n name=\"j\"\n damping = '1'/></body>\n"
    text += b"</worldbody></mujoco>"
    edits = MjcfText(text)
    (joint,) = [i for i in edits.within("worldbody") if edits.tags[i].name == "joint"]
    edits.set(joint, {"damping": "2", "armature": "3"}, "new")
    edits.set(joint, {"name": None})
    result = edits.result()
    assert "<body name='a>b'>" in result and "<!-- new --> <joint" in result
    assert 'damping="2"' in result and 'armature="3"/>' in result and 'name="j"' not in result
