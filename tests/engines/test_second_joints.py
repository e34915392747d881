"""What carries a joint yields: MuJoCo's second joints against equations of another integrator."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.engines.mujoco.urdf_export import export_urdf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import BaseCompliance, CoulombFriction, candidate_effects
from npdr_ppl.models.pendulum import Pendulum

# Two links in a vertical plane, each behind a position servo.
ARM = """
<mujoco>
  <default><joint damping="0.2" armature="0.05" stiffness="0"/></default>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/>
      <inertial pos="0 0 -0.2" mass="3" diaginertia="0.04 0.04 0.01"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" armature="0.02" damping="0.1"/>
        <inertial pos="0 0 -0.15" mass="1.5" diaginertia="0.012 0.012 0.003"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="upper_goal" joint="shoulder" kp="200" kv="10"/>
    <position name="lower_goal" joint="elbow" kp="80" kv="4"/>
  </actuator>
</mujoco>
"""
STEP, STEPS = 0.01, 120
NAMES = "compliance", "time_constant", "damping_ratio"


def goals(start):
    t = STEP * np.arange(STEPS)
    upper = 0.5 * np.sin(3 * t) + 0.2 * np.sin(17 * t)
    lower = 0.6 * (np.sin(4 * t + 1) - np.sin(1)) + 0.2 * np.sin(23 * t)
    return np.stack((start[0] + upper, start[1] + lower), axis=1)


def segment(simulator, start=(0.3, 0.2)):
    values = torch.tensor([[*start, 0.0, 0.0]]).double()
    return Inputs(
        actions=torch.from_numpy(goals(start))[None],
        action_names=("upper_goal", "lower_goal"),
        initial_readings=values,
        initial_values=values,
        channel_names=("shoulder", "elbow", "shoulder_velocity", "elbow_velocity"),
        past_actions=torch.zeros(1, 0, 2).double(),
        time_step=STEP,
        mask=torch.ones(1, STEPS, dtype=torch.bool),
        rollout=torch.zeros(1, dtype=torch.long),
        start=torch.zeros(1, dtype=torch.long),
    )


def by_equations(joint, compliance, time_constant, damping_ratio, start=(0.3, 0.2)):
    """Returns the joints' positions, (steps, 2), by Lagrange's equations of all three turns.

    ``turned[i]`` says which of the carrier and the joints turn link i.
    """
    turned = np.array([[1, 1, 0], [1, 1, 1]] if joint == 0 else [[0, 1, 0], [1, 1, 1]])
    stiffness = 1.0 / compliance
    inertia = time_constant**2 * stiffness
    damping = 2.0 * damping_ratio * time_constant * stiffness

    def mechanics(q, w):
        (a, b), (wa, wb) = turned @ q, turned @ w
        coupling = 1.5 * 0.4 * 0.15
        both = coupling * np.cos(a - b)
        mass = np.array([[0.04 + 3 * 0.2**2 + 1.5 * 0.4**2, both], [both, 0.012 + 1.5 * 0.15**2]])
        spun = coupling * np.sin(a - b) * np.array([wb**2, -(wa**2)])
        weight = 9.81 * np.array([(3 * 0.2 + 1.5 * 0.4) * np.sin(a), 1.5 * 0.15 * np.sin(b)])
        return turned.T @ mass @ turned + np.diag([inertia, 0.05, 0.02]), turned.T @ (
            spun + weight
        )

    def forces(q, w, goal):
        return np.array(
            [
                -stiffness * q[0] - damping * w[0],
                200 * (goal[0] - q[1]) - 10.2 * w[1],
                80 * (goal[1] - q[2]) - 4.1 * w[2],
            ]
        )

    def rate(t, x, goal):
        mass, rest = mechanics(x[:3], x[3:])
        return np.concatenate((x[3:], np.linalg.solve(mass, forces(x[:3], x[3:], goal) - rest)))

    commands = goals(start)
    q, w = np.array([0.0, *start]), np.zeros(3)
    mass, rest = mechanics(q, w)
    held = np.linalg.solve(mass[1:, 1:], (forces(q, w, commands[0]) - rest)[1:])
    q[0] = -compliance * (mass[0, 1:] @ held + rest[0])
    x, found = np.concatenate((q, w)), []
    for goal in commands:
        x = solve_ivp(rate, (0.0, STEP), x, args=(goal,), rtol=1e-8, atol=1e-10).y[:, -1]
        found.append(x[1:3])
    return np.array(found)


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return MujocoSimulator(tmp_path / "arm.xml", time_step=STEP)


def values_of(effect, numbers):
    return {
        f"{effect.name}.{n}": torch.tensor(v).double() for n, v in zip(NAMES, numbers, strict=True)
    }


@pytest.mark.parametrize(
    ("joint", "port", "numbers"),
    [
        (0, "shoulder_torque", (0.002, 0.03, 0.1)),
        (0, "shoulder_torque", (0.01, 0.02, 0.2)),
        (1, "elbow_torque", (0.01, 0.03, 0.05)),
    ],
)
def test_all_links_move_as_the_equations_say(arm, joint, port, numbers):
    effect = BaseCompliance(port)
    fine = arm.with_finer_steps().with_effects(effect)
    assert fine.model.opt.integrator == fine.rigid.model.opt.integrator
    inputs = segment(arm)
    wanted = by_equations(joint, *numbers)
    rigid = by_equations(joint, 1e-9, *numbers[1:])
    found = fine.simulate(values_of(effect, numbers), inputs)[0, :, :2].numpy()
    assert np.abs(found - wanted).max() < 0.01 * np.abs(wanted - rigid).max()
    coarse = fine.with_coarser_steps().simulate(values_of(effect, numbers), inputs)
    plain = arm.simulate({}, inputs)
    change = (coarse - plain)[0, :, :2].numpy()
    assert np.abs(change - (wanted - rigid)).max() < 0.03 * np.abs(wanted - rigid).max()


def test_without_compliance_nothing_changes_by_more_than_rounding_errors(arm):
    inputs = segment(arm)
    attached = arm.with_effects(BaseCompliance("shoulder_torque"), BaseCompliance("elbow_torque"))
    assert attached.model.nv == 4 and attached.states == arm.states
    difference = attached.simulate({}, inputs) - arm.simulate({}, inputs)
    assert float(difference.abs().max()) < 1e-12
    assert attached.carrying(()).model is arm.model


def test_simulations_do_not_depend_on_the_others_of_their_batch(arm):
    effect = BaseCompliance("elbow_torque")
    attached, inputs = arm.with_effects(effect), segment(arm)
    given = {
        f"{effect.name}.{name}": torch.tensor(values).double()
        for name, values in zip(NAMES, ([0.0, 0.01], [0.02, 0.03], [0.1, 0.2]), strict=True)
    }
    out = attached.simulate(given, inputs)
    for k in range(2):
        alone = attached.simulate({name: x[k] for name, x in given.items()}, inputs)
        assert torch.equal(alone, out[k])


def test_other_effects_act_at_their_joints_beside_a_second_joint(arm):
    friction = CoulombFriction("elbow_torque")
    given = {f"{friction.name}.magnitude": torch.tensor(0.4).double()}
    inputs = segment(arm)
    both = arm.with_effects(BaseCompliance("shoulder_torque"), friction)
    alone = arm.with_effects(friction)
    difference = both.simulate(given, inputs) - alone.simulate(given, inputs)
    assert float(difference.abs().max()) < 1e-9


def test_a_short_time_constant_is_as_long_as_the_steps_bear(arm):
    effect = BaseCompliance("elbow_torque")
    light = arm.with_effects(effect).simulate(values_of(effect, (1e-5, 1e-6, 0.1)), segment(arm))
    assert bool(light.isfinite().all())


def test_the_file_that_is_exported_has_the_second_joint(arm, tmp_path):
    effect = BaseCompliance("shoulder_torque")
    attached = arm.with_effects(effect)
    numbers = values_of(effect, (0.01, 0.03, 0.1))
    found = export_mjcf(attached, numbers)
    assert not found.refused and found.callbacks is None
    (tmp_path / "identified.xml").write_text(found.text)
    names = [state.name for state in arm.states]
    again = MujocoSimulator(tmp_path / "identified.xml", time_step=STEP, states=names)
    # At rest, where no spring is bent.
    inputs = segment(arm, start=(0.0, 0.0))
    difference = attached.simulate(numbers, inputs) - again.simulate({}, inputs)
    assert float(difference.abs().max()) < 1e-9


def test_it_needs_a_file_whose_joints_have_names(arm, tmp_path):
    with pytest.raises(ModelError, match="has no file"):
        MujocoSimulator(arm.model).with_effects(BaseCompliance("shoulder_torque"))
    passive = ARM.replace('name="elbow" ', "").replace(
        '<position name="lower_goal" joint="elbow" kp="80" kv="4"/>', ""
    )
    (tmp_path / "unnamed.xml").write_text(passive)
    unnamed = MujocoSimulator(tmp_path / "unnamed.xml")
    with pytest.raises(ModelError, match="needs a name"):
        unnamed.with_effects(BaseCompliance("shoulder_torque"))
    assert "base_compliance" not in {effect.id for effect in candidate_effects(unnamed)}
    with pytest.raises(ModelError, match="cannot apply"):
        Pendulum().with_effects(BaseCompliance("hinge"))


def test_a_urdf_file_has_no_place_for_it(tmp_path):
    (tmp_path / "arm.urdf").write_text("""
        <robot name="arm">
          <link name="base"/>
          <link name="upper"><inertial><origin xyz="0 0 -0.2"/><mass value="3"/>
            <inertia ixx="0.04" iyy="0.04" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
          <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
            <axis xyz="0 1 0"/><dynamics damping="0.2"/></joint>
        </robot>""")
    effect = BaseCompliance("shoulder_torque")
    simulator = MujocoSimulator(tmp_path / "arm.urdf")
    simulator.force_ports[0].port.__dict__["is_driven"] = True
    found = export_urdf(simulator.with_effects(effect), values_of(effect, (0.01, 0.03, 0.1)))
    assert "export an .xml file" in found.refused[effect.name]
