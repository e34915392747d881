"""What carries a joint yields: MuJoCo's second joints against equations of another integrator."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.engines.mujoco import MujocoSimulator, open_loop
from npdr_ppl.engines.mujoco.carrier_past import carrier_past
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.engines.mujoco.randomised import randomised_fields
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.engines.mujoco.urdf_export import export_urdf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    BaseCompliance,
    CoulombFriction,
    InputDelay,
    IntegralAction,
    PeriodicDisturbance,
    candidate_effects,
)
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear
from npdr_ppl.rollouts import Rollouts

# Two links in a vertical plane, each behind a position servo.
ARM = """
<mujoco>
  <default><joint damping="0.2" armature="0.05"/></default>
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
SOFT = (0.01, 0.03, 0.1)


def goals(start):
    t = STEP * np.arange(STEPS)
    upper = 0.5 * np.sin(3 * t) + 0.2 * np.sin(17 * t)
    lower = 0.6 * (np.sin(4 * t + 1) - np.sin(1)) + 0.2 * np.sin(23 * t)
    return np.stack((start[0] + upper, start[1] + lower), axis=1)


def segment(start=(0.3, 0.2)):
    return Inputs.single(
        torch.from_numpy(goals(start)),
        torch.tensor([*start, 0.0, 0.0]).double(),
        action_names=("upper_goal", "lower_goal"),
        state_names=("shoulder", "elbow", "shoulder_velocity", "elbow_velocity"),
        time_step=STEP,
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
    inputs = segment()
    wanted = by_equations(joint, *numbers)
    rigid = by_equations(joint, 1e-9, *numbers[1:])
    found = fine.simulate(values_of(effect, numbers), inputs)[0, :, :2].numpy()
    assert np.abs(found - wanted).max() < 2e-4 * np.abs(wanted - rigid).max()
    # The file's integrator is of first order, so its error is a share of the step.
    coarse = fine.with_coarser_steps().simulate(values_of(effect, numbers), inputs)
    plain = arm.simulate({}, inputs)
    change = (coarse - plain)[0, :, :2].numpy()
    assert np.abs(change - (wanted - rigid)).max() < 0.03 * np.abs(wanted - rigid).max()


def test_without_compliance_nothing_changes_by_more_than_rounding_errors(arm):
    inputs = segment()
    attached = arm.with_effects(BaseCompliance("shoulder_torque"), BaseCompliance("elbow_torque"))
    assert attached.model.nv == 4 and attached.states == arm.states
    difference = attached.simulate({}, inputs) - arm.simulate({}, inputs)
    assert float(difference.abs().max()) < 1e-12
    assert attached.carrying(()).model is arm.model


def recorded(joint, numbers, noise=0.0, *, rates=False):
    """Returns a recording by the equations: positions, with ``rates`` also velocities."""
    start = np.array([0.3, 0.2])
    positions = np.concatenate((start[None], by_equations(joint, *numbers)))
    positions += noise * np.random.default_rng(0).standard_normal(positions.shape)
    names = ("shoulder", "elbow")
    if rates:
        positions = np.concatenate((positions, np.gradient(positions, STEP, axis=0)), axis=1)
        names = (*names, "shoulder_velocity", "elbow_velocity")
    return Rollouts(
        [positions],
        [goals(start)],
        channel_names=names,
        action_names=("upper_goal", "lower_goal"),
        time_step=STEP,
    )


@pytest.mark.parametrize(
    ("joint", "port", "numbers"),
    [(0, "shoulder_torque", (0.01, 0.03, 0.1)), (1, "elbow_torque", (0.02, 0.03, 0.2))],
)
@pytest.mark.parametrize(
    ("noise", "rates", "history", "left"),
    [(0.0, False, None, 0.12), (1e-4, False, None, 0.12), (1e-4, True, 50, 0.2)],
)
def test_a_carrier_swings_on_from_segment_to_segment(
    arm, joint, port, numbers, noise, rates, history, left
):
    effect = BaseCompliance(port)
    attached = arm.with_finer_steps().with_effects(effect)
    wanted = torch.tensor(recorded(joint, numbers).readings[0][1:]).reshape(-1, 20, 2)
    recording = recorded(joint, numbers, noise, rates=rates)
    inputs = recording.inputs(segment_length=20, history=history)

    def errors(inputs):
        found = attached.simulate(values_of(effect, numbers), inputs)[..., :2]
        return (found - wanted).square().mean((1, 2))

    swings = errors(inputs)
    begins_at_rest = errors(replace(inputs, recorded_readings=None))
    assert swings[0] == begins_at_rest[0]
    assert float(swings[1:].mean().sqrt()) < left * float(begins_at_rest[1:].mean().sqrt())


@pytest.mark.parametrize("rates", [False, True])
def test_the_past_begins_where_the_recording_was(arm, rates):
    inputs = recorded(1, SOFT, rates=rates).inputs(segment_length=20, history=30)
    attached = arm.with_effects(BaseCompliance("elbow_torque"))
    shape = torch.Size((inputs.num_segments,))
    past = carrier_past(attached, inputs, shape, attached.initial_states(inputs))
    assert past.lengths.tolist() == [0, 20, 30, 30, 30, 30]
    positions = recorded(1, SOFT).readings[0]
    begin = (inputs.start - past.lengths)[1:].numpy()
    # A parabola through 40 ms misses the third derivative of the sine of 0.2 rad and 23 rad/s.
    for joint in range(2):
        assert past.states[joint][1:].numpy() == pytest.approx(positions[begin, joint], abs=3e-3)
        rate = np.gradient(positions[:, joint], STEP, edge_order=2)[begin]
        assert past.states[2 + joint][1:].numpy() == pytest.approx(rate, abs=0.3)


def test_a_rigid_carrier_changes_nothing_after_a_past_either(arm):
    inputs = recorded(1, SOFT).inputs(segment_length=20)
    attached = arm.with_effects(BaseCompliance("shoulder_torque"))
    difference = attached.simulate({}, inputs) - arm.simulate({}, inputs)
    assert float(difference.abs().max()) < 1e-9


def test_a_segment_does_not_depend_on_those_that_it_is_simulated_with(arm):
    carrier, integral = BaseCompliance("elbow_torque"), IntegralAction("lower_goal")
    attached = arm.with_effects(carrier, integral, PeriodicDisturbance("elbow_torque"))
    numbers = values_of(carrier, SOFT) | {f"{integral.name}.rate": torch.tensor(2.0).double()}
    for name, value in (("sine", 0.5), ("frequency", 2.0)):
        numbers[f"elbow_torque.periodic_disturbance.{name}"] = torch.tensor(value).double()
    inputs = recorded(1, SOFT).inputs(segment_length=20)
    together = attached.simulate(numbers, inputs)
    for k in range(inputs.num_segments):
        alone = attached.simulate(numbers, inputs.segments([k]))
        assert float((alone[0] - together[k]).abs().max()) < 1e-9


def test_segments_of_a_past_that_diverges_begin_at_rest(arm, monkeypatch):
    inputs = recorded(1, SOFT).inputs(segment_length=20)
    attached = arm.with_effects(BaseCompliance("elbow_torque"))
    numbers = values_of(attached.effects[0], SOFT)
    resting = attached.simulate(numbers, replace(inputs, recorded_readings=None))

    def wild(*arguments):
        past = carrier_past(*arguments)
        return past._replace(states=tuple(1e12 + 0.0 * state for state in past.states))

    monkeypatch.setattr(open_loop, "carrier_past", wild)
    assert float((attached.simulate(numbers, inputs) - resting).abs().max()) < 1e-9


def test_commands_may_have_further_axes_than_those_before_them(arm):
    inputs = recorded(1, SOFT).inputs(segment_length=20)
    several = replace(inputs, actions=inputs.actions + torch.zeros(3, 1, 1, 1))
    for simulator in (arm, arm.with_effects(BaseCompliance("elbow_torque"))):
        found = simulator.simulate({}, several)
        assert found.shape == (3, 6, 20, 4)
        assert torch.equal(found[1], simulator.simulate({}, inputs))


def test_the_past_of_a_carrier_passes_through_the_effects_on_commands(arm):
    carrier, delay = BaseCompliance("elbow_torque"), InputDelay("lower_goal")
    numbers = values_of(carrier, SOFT)
    inputs = recorded(1, SOFT).inputs(segment_length=20)
    alone = arm.with_effects(carrier).simulate(numbers, inputs)
    both = arm.with_effects(carrier, delay)
    prompt = {**numbers, f"{delay.name}.delay": torch.tensor(0.0).double()}
    assert float((both.simulate(prompt, inputs) - alone).abs().max()) < 1e-12
    # A goal that comes one step late is the goal of the step before, at first the first one.
    late = {**numbers, f"{delay.name}.delay": torch.tensor(STEP).double()}
    goal = torch.cat((inputs.past_actions, inputs.actions), dim=-2)
    shifted, past = goal.clone(), inputs.past_actions.shape[-2]
    shifted[:, 1:, 1] = goal[:, :-1, 1]
    for segment, start in enumerate(inputs.start):
        shifted[segment, past - start, 1] = goal[segment, past - start, 1]
    by_hand = replace(inputs, past_actions=shifted[:, :past], actions=shifted[:, past:])
    difference = both.simulate(late, inputs) - arm.with_effects(carrier).simulate(numbers, by_hand)
    assert float(difference.abs().max()) < 1e-6


def test_simulations_do_not_depend_on_the_others_of_their_batch(arm):
    effect = BaseCompliance("elbow_torque")
    attached, inputs = arm.with_effects(effect), segment()
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
    inputs = segment()
    both = arm.with_effects(BaseCompliance("shoulder_torque"), friction)
    alone = arm.with_effects(friction)
    difference = both.simulate(given, inputs) - alone.simulate(given, inputs)
    assert float(difference.abs().max()) < 1e-9


def test_a_short_time_constant_is_as_long_as_the_steps_bear(arm):
    effect = BaseCompliance("elbow_torque")
    light = arm.with_effects(effect).simulate(values_of(effect, (1e-5, 1e-6, 0.1)), segment())
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
    inputs = segment(start=(0.0, 0.0))
    difference = attached.simulate(numbers, inputs) - again.simulate({}, inputs)
    assert float(difference.abs().max()) < 1e-9


def test_a_search_considers_it_only_if_it_is_asked_for(arm):
    hypothesis = SimpleNamespace(
        simulator=arm,
        names=(),
        segments=SimpleNamespace(inputs=segment(), recorded_rates=None),
    )
    every = candidates_at(hypothesis, DiscoveryOptions())
    assert every and "base_compliance" not in {effect.id for effect in every}
    asked = DiscoveryOptions(effects=(BaseCompliance("elbow_torque"),))
    assert [effect.id for effect in candidates_at(hypothesis, asked)] == ["base_compliance"]


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
    found = export_urdf(simulator.with_effects(effect), values_of(effect, (0.01, 0.03, 0.1)))
    assert "export an .xml file" in found.refused[effect.name]


CART = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body name="cart" pos="0 0 1" gravcomp="{gravcomp}">
      <joint name="rail" type="slide" axis="1 0 0" damping="5"/>
      <joint name="hinge" axis="0 1 0" pos="0 0 {height}" damping="0.1" armature="0.01"/>
      <inertial pos="0.3 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
    </body>
  </worldbody>
  <actuator>
    <position name="along" joint="rail" kp="500" kv="5"/>
    <position name="up" joint="hinge" kp="100" kv="5"/>
  </actuator>
  <keyframe><key name="home" qpos="0.2 -0.3" qvel="0.1 0.4"/></keyframe>
</mujoco>
"""
HINGE = BaseCompliance("hinge_torque")


def cart(folder, *, integrator="implicitfast", gravcomp=0, height=0.1, parameters=None):
    """Returns a slide and a hinge in one body, each behind a servo."""
    path = folder / f"cart_{height}.xml"
    path.write_text(CART.format(integrator=integrator, gravcomp=gravcomp, height=height))
    return MujocoSimulator(path, parameters, time_step=STEP)


def still(simulator, goal, num_steps=50):
    """Returns a segment from rest at zero with a constant goal of the hinge."""
    return Inputs.single(
        torch.tensor([0.0, goal]).double().expand(num_steps, 2),
        torch.zeros(4).double(),
        action_names=("along", "up"),
        state_names=tuple(state.name for state in simulator.states),
        time_step=STEP,
    )


def test_a_joint_behind_another_in_one_body_keeps_its_axis_and_the_keyframe(tmp_path):
    attached = cart(tmp_path).with_effects(HINGE, BaseCompliance("rail_force"))
    model = attached.model
    names = [model.joint(j).name for j in range(4)]
    assert names == ["rail_carrier", "rail", "hinge_carrier", "hinge"]
    assert model.key_qpos[0].tolist() == [0.0, 0.2, 0.0, -0.3]
    assert model.key_qvel[0].tolist() == [0.0, 0.1, 0.0, 0.4]
    data = mujoco.MjData(model)
    data.qpos[1] = 0.5
    mujoco.mj_forward(model, data)
    assert data.xanchor[2] == pytest.approx(data.xanchor[3])
    assert data.xaxis[2] == pytest.approx(data.xaxis[3])


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize("numbers", [(0.02, 1e-4, 30.0), (0.02, 0.005, 0.1), (1e-4, 0.02, 3.0)])
def test_light_and_strongly_damped_carriers_stay_stable(tmp_path, integrator, numbers):
    attached = cart(tmp_path, integrator=integrator).with_effects(HINGE)
    moved = attached.simulate(values_of(HINGE, numbers), still(attached, 0.3))
    assert bool(moved.isfinite().all()) and float(moved.abs().max()) < 10.0


@pytest.mark.parametrize("bound", ["joint hinge damping", "actuator up kv"])
def test_a_light_carrier_stays_stable_behind_a_drive_that_a_parameter_damps(tmp_path, bound):
    attached = cart(tmp_path, integrator="RK4", parameters={"damping": bound}).with_effects(HINGE)
    given = {**values_of(HINGE, (0.02, 1e-4, 0.1)), "damping": torch.tensor([5.0, 60.0]).double()}
    moved = attached.simulate(given, still(attached, 0.3))
    assert bool(moved.isfinite().all()) and float(moved.abs().max()) < 10.0


def test_no_default_of_the_file_reaches_a_carrier(tmp_path):
    classes = '<default><joint stiffness="1 2 3" damping="1 2 3" springdamper="0 0"/></default>'
    (tmp_path / "arm.xml").write_text(ARM.replace("<worldbody>", classes + "<worldbody>", 1))
    attached = MujocoSimulator(tmp_path / "arm.xml").with_effects(BaseCompliance("elbow_torque"))
    second = attached.second_joints["elbow_torque"]
    model = attached.model
    assert model.jnt_stiffness[second.joint] == model.dof_damping[second.velocity] == 0.0
    for name, row in (("jnt_stiffnesspoly", second.joint), ("dof_dampingpoly", second.velocity)):
        assert not hasattr(model, name) or not np.any(getattr(model, name)[row])


def settled(attached, given, goal, monkeypatch):
    """Returns where the hinge's second joint begins."""
    begin, found = MujocoStepper.settle, []

    def noted(self, *arguments):
        begin(self, *arguments)
        place = attached.second_joints[HINGE.port].position
        found.append(float(self._qpos[0, place]))

    with monkeypatch.context() as patch:
        patch.setattr(MujocoStepper, "settle", noted)
        attached.simulate(given, still(attached, goal, 1))
    return found[0]


def test_the_spring_balances_weight_drive_and_friction_at_first(tmp_path, monkeypatch):
    numbers = values_of(HINGE, SOFT)
    plain = cart(tmp_path)
    free = settled(plain.with_effects(HINGE), numbers, 0.2, monkeypatch)
    # The rail carries the cart; the hinge's link is 0.3 m ahead of the anchor and 0.1 m below it.
    weight, drive, rotor = 9.81 * 0.3, 100 * 0.2, 0.01
    inertia = np.array([[1.0, 0.1], [0.1, 0.01 + 0.3**2 + 0.1**2 + rotor]])
    for sign in (-1, 1):  # of the coupling, which follows from the direction of the axis
        inertia[0, 1] = inertia[1, 0] = sign * 0.1
        acceleration = np.linalg.solve(inertia, [0.0, drive + weight])[1]
    assert free == pytest.approx(-0.01 * (drive - rotor * acceleration), rel=1e-3)
    # With enough friction at the joint nothing moves, and the spring carries the weight alone.
    friction = CoulombFriction("hinge_torque")
    held = {**numbers, f"{friction.name}.magnitude": torch.tensor(100.0).double()}
    stuck = settled(plain.with_effects(HINGE, friction), held, 0.2, monkeypatch)
    assert stuck == pytest.approx(0.01 * weight, rel=0.02)


def test_weights_that_the_engine_compensates_bend_no_spring(tmp_path):
    attached = cart(tmp_path, gravcomp=1).with_effects(HINGE)
    names = tuple(state.name for state in attached.states)
    episodes = attached.roll_out(
        values_of(HINGE, SOFT),
        Linear(names, ("along", "up")),
        torch.zeros(1, 4).double(),
        20,
        record=True,
    )
    assert float(episodes.readings.abs().max()) < 1e-9


def test_a_parameter_that_moves_the_joint_moves_its_carrier(tmp_path):
    numbers = values_of(HINGE, SOFT)
    bound = cart(tmp_path, parameters={"height": "joint hinge position z"}).with_effects(HINGE)
    high = cart(tmp_path, height=0.3).with_effects(HINGE)
    found = bound.simulate({**numbers, "height": torch.tensor(0.3).double()}, still(bound, 0.3))
    assert float((found - high.simulate(numbers, still(high, 0.3))).abs().max()) < 1e-6


def test_draws_for_an_environment_leave_it_out(arm):
    effect = BaseCompliance("shoulder_torque")
    fields = randomised_fields(arm.with_effects(effect), values_of(effect, SOFT))
    assert "adds a joint" in fields.refused[effect.name] and not fields.fields
