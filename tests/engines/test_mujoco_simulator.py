"""MuJoCo as a simulator of any MJCF file: channels, parameters, batches, inference."""

import math
import pickle

import mujoco
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco import MujocoSimulator, Scale, batches
from npdr_ppl.engines.mujoco import open_loop as mujoco_open_loop
from npdr_ppl.engines.mujoco.damping import fastest_damping
from npdr_ppl.errors import DataError, ModelError, ShapeError
from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_dynamics import Motion
from npdr_ppl.models.effects import (
    Bias,
    CoulombFriction,
    InputDelay,
    ViscousFriction,
)
from npdr_ppl.models.two_link_arm import TwoLinkArm
from tests.helpers.mujoco_files import (
    ARM,
    GYMNASIUM,
    arm,
    needs_gymnasium,
    random_inputs,
    value,
)


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """The engine writes its own warnings to a file in the present folder."""
    monkeypatch.chdir(tmp_path)


# On files that were not written for this simulator.

FILES = (
    "ant",
    "half_cheetah",
    "hopper",
    "humanoid",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "point",
    "pusher",
    "pusher_v5",
    "reacher",
    "swimmer",
    "walker2d",
)


@needs_gymnasium
@pytest.mark.parametrize("name", FILES)
def test_files_of_others_run_as_the_engine_runs_them(name):
    simulator = MujocoSimulator(GYMNASIUM / f"{name}.xml")
    inputs = random_inputs(simulator, num_steps=20)
    out = simulator.simulate({}, inputs)
    assert out.shape == (3, 20, len(simulator.states))
    assert out.isfinite().all()
    model = mujoco.MjModel.from_xml_path(str(GYMNASIUM / f"{name}.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = inputs.initial_values[0, : model.nq].numpy()
    data.qvel[:] = inputs.initial_values[0, model.nq :].numpy()
    for step in range(20):
        data.ctrl[:] = inputs.actions[0, step].numpy()
        mujoco.mj_step(model, data)
        expected = np.concatenate((data.qpos, data.qvel))
        assert np.array_equal(out[0, step].numpy(), expected)


@needs_gymnasium
@pytest.mark.parametrize("name", FILES)
def test_channels_and_ports_of_files_of_others(name):
    simulator = MujocoSimulator(GYMNASIUM / f"{name}.xml")
    model = simulator.model
    names = [c.name for c in (*simulator.states, *simulator.actions)]
    names += list(simulator.joints)
    assert len(set(names)) == len(names)
    assert len({port.name for port in simulator.ports}) == len(simulator.ports)
    assert len(simulator.states) == model.nq + model.nv
    assert len(simulator.actions) == model.nu
    for port in simulator.ports:
        assert math.isfinite(port.rated) and port.rated > 0.0
        assert math.isfinite(port.rated_speed) and port.rated_speed > 0.0
    for state in simulator.states:
        assert state.rate_of is None or state.rate_of in names


@needs_gymnasium
def test_warnings_about_a_file_are_logged(caplog, tmp_path):
    MujocoSimulator(GYMNASIUM / "half_cheetah.xml")
    assert all(record.name.startswith("npdr_ppl") for record in caplog.records)
    assert not list(tmp_path.iterdir())


@needs_gymnasium
def test_free_joints_are_named_and_can_be_left_out():
    ant = MujocoSimulator(GYMNASIUM / "ant.xml")
    names = [state.name for state in ant.states]
    assert names[:7] == [f"root_{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    assert {"root_x_velocity", "root_x_spin"} <= set(names)
    legs = [n for n in names if not n.startswith("root")]
    chosen = MujocoSimulator(GYMNASIUM / "ant.xml", states=legs)
    inputs = random_inputs(ant, num_segments=1)
    inputs.initial_values[:, :7] = torch.tensor(ant.model.qpos0[:7])
    inputs.initial_values[:, 15:21] = 0.0
    columns = [names.index(name) for name in legs]
    out = chosen.simulate({}, inputs.select_channels(legs))
    assert torch.equal(out, ant.simulate({}, inputs)[..., columns])


# Parameters.


@needs_gymnasium
def test_parameters_are_fields_of_the_engines_model():
    simulator = MujocoSimulator(
        GYMNASIUM / "hopper.xml",
        {
            "torso": "body torso mass",
            "damping": ["joint leg_joint damping", "joint foot_joint damping"],
            "density": Scale("body foot mass", "body foot inertia"),
            "floor": "geom floor friction sliding",
            "gravity": "option gravity z",
            "gear": "actuator thigh_joint_command gear",
        },
    )
    by_name = {parameter.name: parameter for parameter in simulator.parameters}
    assert (by_name["torso"].unit, by_name["gravity"].unit) == ("kg", "m/s²")
    assert by_name["damping"].unit == "N m s/rad"
    assert by_name["density"].nominal == 1.0
    model = simulator.model
    torso, foot = model.body("torso").id, model.body("foot").id
    assert by_name["torso"].nominal == model.body_mass[torso]
    inputs = random_inputs(simulator, num_segments=1)
    given = {"torso": 5.0, "damping": 0.3, "density": 1.5, "floor": 0.4, "gravity": -5.0}
    given = {name: value(v) for name, v in {**given, "gear": 150.0}.items()}
    out = simulator.simulate(given, inputs)
    # The same, by hand.
    changed = mujoco.MjModel.from_xml_path(str(GYMNASIUM / "hopper.xml"))
    changed.body_mass[torso] = 5.0
    changed.body_mass[foot] *= 1.5
    changed.body_inertia[foot] *= 1.5
    changed.dof_damping[[4, 5]] = 0.3
    changed.geom_friction[changed.geom("floor").id, 0] = 0.4
    changed.opt.gravity[2] = -5.0
    changed.actuator_gear[0, 0] = 150.0
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    assert torch.equal(out, MujocoSimulator(changed).simulate({}, inputs))
    # In a batch as alone.
    pair = {name: torch.stack((v, 0.9 * v)) for name, v in given.items()}
    assert torch.equal(simulator.simulate(pair, inputs)[0], out)
    # The file's own model stays as it was.
    assert model.body_mass[torso] == by_name["torso"].nominal


def test_servo_gain_is_gain_and_bias():
    simulator = arm(parameters={"kp": "actuator elbow_command kp"})
    assert simulator.parameters[0].nominal == 4.0
    assert simulator.parameters[0].unit == "N m/rad"
    inputs = random_inputs(simulator)
    stiff = arm()
    stiff.model.actuator_gainprm[1, 0], stiff.model.actuator_biasprm[1, 1] = 7.0, -7.0
    out = simulator.simulate({"kp": value(7.0)}, inputs)
    assert torch.equal(out, stiff.simulate({}, inputs))


def test_a_loaded_joint_creeps_less_if_its_friction_is_harder(tmp_path):
    path = tmp_path / "held.xml"
    path.write_text(
        '<mujoco><option timestep="0.001"/><worldbody><body>'
        '<joint name="j" axis="0 1 0" armature="0.03" frictionloss="0.4"/>'
        '<geom size="0.001" pos="0.1 0 0" mass="0.15"/></body></worldbody></mujoco>'
    )
    simulator = MujocoSimulator(path, {"softness": "joint j friction_softness"})
    assert simulator.parameters[0].nominal == pytest.approx(0.1)
    softness = value([0.1, 0.01, 0.001, 0.0001, 0.0])
    inputs = Inputs.single(
        torch.zeros(200, 0, dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
        action_names=(),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    )
    speed = simulator.simulate({"softness": softness}, inputs)[:, 0, -1, 1]
    force, inertia = 0.15 * 9.81 * 0.1, 0.03 + 0.15 * 0.1**2
    # The engine's default time constant is 0.02 s, and its default impedance far away is 0.95.
    time_constant = 0.002 + (0.02 - 0.002) * softness / 0.1
    expected = 0.95 * time_constant * force * softness / (1.0 - softness) / (2.0 * inertia)
    torch.testing.assert_close(speed[:4], expected[:4], rtol=0.02, atol=0.0)
    # At zero, the engine takes the impedance of 0.0001; only the time constant is still shorter.
    torch.testing.assert_close(speed[4], speed[3], rtol=0.02, atol=0.0)


def test_friction_of_an_effect_has_the_softness_of_its_joint():
    friction = CoulombFriction("elbow_torque")
    given = {f"{friction.name}.magnitude": value(0.3)}
    hard = arm().with_effects(friction)
    bound = arm(parameters={"softness": "joint elbow friction_softness"}).with_effects(friction)
    inputs = random_inputs(hard)
    plain = bound.simulate(given, inputs)
    nominal = {"softness": value(bound.parameters[0].nominal)}
    assert torch.equal(plain, bound.simulate(given | nominal, inputs))
    assert not torch.equal(plain, hard.simulate(given, inputs))
    with pytest.raises(ModelError, match="no such joint has dry friction"):
        arm(parameters={"softness": "joint * friction_softness"})


def test_a_factor_on_a_softness_scales_it():
    binding = {"factor": Scale("joint * friction_softness")}
    simulator, direct = arm(friction=0.1, parameters=binding), arm(friction=0.1)
    direct.model.dof_solimp[:, 0] = 1.0 - 0.1 * 0.2
    least = 2.0 * direct.model.opt.timestep
    direct.model.dof_solref[:, 0] = least + (0.02 - least) * 0.2
    inputs = random_inputs(simulator)
    out = simulator.simulate({"factor": value(0.2)}, inputs)
    torch.testing.assert_close(out, direct.simulate({}, inputs), rtol=1e-9, atol=1e-9)
    assert (out - arm(friction=0.1).simulate({}, inputs)).abs().max() > 1e-4


def test_a_parameter_without_a_field_enters_derived_ones():
    simulator = arm(
        parameters={"payload": Parameter("payload", "kg", 0.1)},
        derived={"body hand mass": lambda p: 0.3 + p["payload"]},
    )
    inputs = random_inputs(simulator)
    direct = arm(parameters={"hand": "body hand mass"})
    out = simulator.simulate({"payload": value([0.2, 0.5])}, inputs)
    expected = direct.simulate({"hand": value([0.5, 0.8])}, inputs)
    assert torch.equal(out, expected)
    assert torch.equal(
        simulator.simulate({}, inputs), direct.simulate({"hand": value(0.4)}, inputs)
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameters": {"m": "body hnad mass"}}, "did you mean 'hand'"),
        ({"parameters": {"m": "body hand mas"}}, "did you mean 'mass'"),
        ({"parameters": {"m": "bodies hand mass"}}, "did you mean 'body'"),
        ({"parameters": {"m": "body hand inertia w"}}, "no component 'w'"),
        ({"parameters": {"m": "body hand inertia"}}, "Scale"),
        ({"parameters": {"m": ["body hand mass", "joint elbow damping"]}}, "kg"),
        ({"parameters": {"m": "body hand mass", "n": Scale("body * mass")}}, "both set"),
        ({"parameters": {"m": Parameter("n", "kg", 1.0)}}, "declared as 'n'"),
        ({"parameters": {"m": []}}, "sets no field"),
        ({"parameters": {"m": "option wind"}}, "zero in the file"),
        ({"states": ["sholder", "elbow"]}, "did you mean 'shoulder'"),
        ({"sensors": ["encodr"]}, "did you mean 'encoder'"),
        ({"units": {"motr": "V"}}, "did you mean 'motor'"),
        ({"bounds": {"elbw": (0, 1)}}, "did you mean 'elbow'"),
        ({"keyframe": "raise"}, "did you mean 'raised'"),
        ({"substeps": 0}, "substeps"),
        ({"held": ["joint shoulder dampng"]}, "did you mean 'damping'"),
    ],
)
def test_errors_name_what_exists(options, message):
    with pytest.raises(ModelError, match=message):
        arm(**options)


def test_viscous_friction_corrects_damping_that_is_held():
    simulator = arm(held=["joint elb* damping", "body hand mass"])
    inputs = random_inputs(simulator)
    ports = [port.name for port in simulator.ports if port.kind == "force"]
    elbow, shoulder = (next(p for p in ports if p.startswith(n)) for n in ("elbow", "shoulder"))
    assert simulator.corrected_number(ViscousFriction(elbow)) == "joint elbow damping"
    assert simulator.corrected_number(ViscousFriction(shoulder)) == ""
    assert simulator.corrected_number(CoulombFriction(elbow)) == ""
    # The sum is never negative.
    damped = simulator.with_effects(ViscousFriction(elbow))
    less = damped.simulate({f"{elbow}.viscous_friction.damping": value([-9.0, -8.0, 0.0])}, inputs)
    assert torch.equal(less[0], less[1]) and not torch.equal(less[1], less[2])
    every = simulator.with_effects(CoulombFriction(elbow)).with_finer_steps()
    assert every.corrected_number(ViscousFriction(elbow)) == "joint elbow damping"


def test_files_and_inputs_that_do_not_fit(tmp_path):
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><bodi/></worldbody></mujoco>")
    with pytest.raises(ModelError, match=r"bad\.xml is not a readable MJCF"):
        MujocoSimulator(tmp_path / "bad.xml")
    simulator = arm(parameters={"hand": "body hand mass"})
    inputs = random_inputs(simulator)
    with pytest.raises(ModelError, match="no parameter mass"):
        simulator.simulate({"mass": value(1.0)}, inputs)
    renamed = Inputs(**{**vars(inputs), "action_names": ("a", "b")})
    with pytest.raises(DataError, match="needs the action motor"):
        simulator.simulate({}, renamed)
    with pytest.raises(ModelError, match="no port 'wrist'"):
        simulator.with_effects(CoulombFriction("wrist"))
    unit = {"a": Parameter("a", "1", 1.0)}
    with pytest.raises(ShapeError, match="one value per simulation"):
        arm(parameters=unit, derived={"body hand mass": lambda p: torch.ones(5)})
    with pytest.raises(ModelError, match="no parameter 'b'"):
        arm(parameters=unit, derived={"body hand mass": lambda p: p["b"]})


# Batches, segments and masks.


def test_batch_equals_a_loop(monkeypatch):
    simulator = arm(
        parameters={"hand": "body hand mass", "damping": "joint elbow damping"}
    ).with_effects(CoulombFriction("shoulder_torque"), InputDelay("motor"))
    inputs = random_inputs(simulator)
    generator = torch.Generator().manual_seed(1)
    parameters = {
        "hand": 0.3 + torch.rand(5, 1, generator=generator).double(),
        "damping": 0.1 * torch.rand(4, generator=generator).double(),
        "shoulder_torque.coulomb_friction.magnitude": 0.1 * torch.rand(5, 4).double(),
        "motor.input_delay.delay": value(0.005),
    }
    batch = simulator.simulate(parameters, inputs)
    assert batch.shape == (5, 4, 3, 30, 4)
    for i in range(5):
        for j in range(4):
            one = {name: v.expand(5, 4)[i, j] for name, v in parameters.items()}
            for s in range(3):
                alone = simulator.simulate(one, inputs.segments([s]))
                assert torch.equal(batch[i, j, s], alone[0])
    # The same in small chunks, and on several threads.
    monkeypatch.setattr(mujoco_open_loop, "CHUNK_BYTES", 1 << 15)
    assert torch.equal(simulator.simulate(parameters, inputs), batch)
    simulator.num_threads = 2
    assert torch.equal(simulator.simulate(parameters, inputs), batch)


def test_without_constraints_their_solver_is_skipped_and_values_stay(monkeypatch):
    friction = "shoulder.coulomb_friction.magnitude"

    def simulated(*effects, **parameters):
        simulator = TwoLinkArm().with_effects(*effects)
        trajectory = simulator.simulate(parameters, random_inputs(simulator))
        (model,) = simulator.prepared_models.values()
        return trajectory, bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)

    masses = {"lower_mass": torch.tensor([0.5, 1.0]).double()}
    skipped, is_skipped = simulated(**masses)
    assert is_skipped
    rubbing, is_skipped = simulated(
        CoulombFriction("shoulder"), **masses, **{friction: value(0.5)}
    )
    assert not is_skipped
    assert not torch.allclose(rubbing, skipped)
    monkeypatch.setattr(batches, "has_constraints", lambda model: True)
    solved, is_skipped = simulated(**masses)
    assert not is_skipped
    assert torch.equal(solved, skipped)


@pytest.mark.parametrize(
    "text",
    [
        '<joint axis="0 1 0" limited="true" range="-1 1"/>',
        '<joint axis="0 1 0" frictionloss="0.1"/>',
        '<joint axis="0 1 0"/><geom size="0.1"/>',
    ],
)
def test_limits_friction_and_geometries_are_constraints(text):
    body = f'<body><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/>{text}</body>'
    xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    assert batches.has_constraints(mujoco.MjModel.from_xml_string(xml))


def test_steps_that_do_not_exist_are_zero():
    simulator = arm()
    inputs = random_inputs(simulator)
    out = simulator.simulate({}, inputs)
    assert (out[~inputs.mask] == 0.0).all()
    assert (out[inputs.mask].abs().sum(-1) > 0.0).all()


def test_inputs_may_have_a_batch_of_their_own():
    simulator = arm(parameters={"hand": "body hand mass"})
    some, other = random_inputs(simulator), random_inputs(simulator, seed=1)
    both = Inputs(
        **{
            **vars(some),
            **{
                name: torch.stack((getattr(some, name), getattr(other, name)))
                for name in ("actions", "past_actions", "initial_readings", "initial_values")
            },
        }
    )
    out = simulator.simulate({"hand": value(0.5)}, both)
    assert torch.equal(out[0], simulator.simulate({"hand": value(0.5)}, some))
    assert torch.equal(out[1], simulator.simulate({"hand": value(0.5)}, other))


def test_substeps_divide_the_control_step():
    assert arm().time_step == 0.002
    assert arm(substeps=5).time_step == pytest.approx(0.01)
    assert arm(time_step=0.01).num_substeps(0.01) == 5
    coarse, fine = arm(time_step=0.01), arm()
    inputs = random_inputs(coarse, num_segments=1)
    repeated = Inputs(
        **{
            **vars(inputs),
            "actions": inputs.actions.repeat_interleave(5, dim=1),
            "mask": inputs.mask.repeat_interleave(5, dim=1),
            "time_step": 0.002,
        }
    )
    assert torch.equal(coarse.simulate({}, inputs), fine.simulate({}, repeated)[:, 4::5])


@pytest.mark.parametrize(
    ("integrator", "most", "substeps"), [("Euler", (0.5, 0.25), (1, 2)), ("RK4", (0.55,), (2,))]
)
def test_finer_steps_err_less(integrator, most, substeps):
    # The engine's order helps the equations, not forces of effects, which it holds for a step.
    drag = ViscousFriction("shoulder_torque")
    strength = {"shoulder_torque.viscous_friction.damping": value(0.3)}
    inputs = random_inputs(arm(), num_segments=1, num_steps=100)

    def readings(simulator):
        return simulator.with_effects(drag).simulate(strength, inputs)

    finer = coarse = arm(integrator=integrator)
    exact = readings(arm(integrator="RK4", substeps=64))
    natural = arm(integrator="RK4", substeps=64).simulate({}, inputs)
    error = (readings(coarse) - exact).norm()
    for share, number in zip(most, substeps, strict=True):
        finer = finer.with_finer_steps()
        assert (readings(finer) - exact).norm() < share * error
        assert finer.num_substeps(0.002) == number
        # Without effects only the order is left.
        torch.testing.assert_close(finer.simulate({}, inputs), natural, rtol=1e-5, atol=1e-7)
    assert finer.with_finer_steps() is None
    assert coarse.num_substeps(0.002) == 1


STIFF = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/><joint name="hinge" axis="0 1 0"
armature="0.08"/></body></worldbody><actuator><position name="servo" joint="hinge" kp="2000"
kv="{kv}"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("kv", "substeps"), [(126, (2, 4)), (240, (2, 4)), (400, (4, 8)), (4000, (4,))]
)
def test_the_finest_steps_of_stiff_servos_err_little(tmp_path, kv, substeps):
    # With kv = 400, velocities decay at 4000/s: steps of order four diverge from 1400/s on, those
    # of a quarter of the length do not. With ten times that, the file's integrator is kept.
    path = tmp_path / "servo.xml"
    path.write_text(STIFF.format(kv=kv))
    finer = coarse = MujocoSimulator(path)
    damping = fastest_damping(coarse.model, coarse.initial_positions)
    assert damping == pytest.approx(kv / (0.08 + 0.01 + 0.1**2))
    exact = MujocoSimulator(path, substeps=1000, time_step=0.002)
    exact.model.opt.timestep = 2e-6
    inputs = random_inputs(coarse, num_segments=1, num_steps=100)
    far, best = coarse.simulate({}, inputs), exact.simulate({}, inputs)
    for number in substeps:
        finer = finer.with_finer_steps()
        assert finer.num_substeps(0.002) == number
    assert (finer.simulate({}, inputs) - best).norm() < 0.02 * (far - best).norm()
    assert finer.with_finer_steps() is None


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("attached", [(), (Bias("shoulder"),)], ids=["native", "stepped"])
def test_sensor_elements_describe_the_present_state(substeps, attached):
    # Renamed states leave the joint's name to its port.
    simulator = arm(
        sensors=["encoder", "gyro_y", "imu_x", "angle"],
        states={"angle": "shoulder", "other": "elbow", "r": "shoulder_velocity",
                "s": "elbow_velocity"},
        substeps=substeps,
    ).with_effects(*attached)  # fmt: skip
    units = [sensor.unit for sensor in simulator.sensors]
    assert units == ["rad", "rad/s", "m/s²", "rad"]
    inputs = random_inputs(simulator, num_segments=1, num_steps=10)
    out = simulator.simulate({}, inputs)
    assert torch.equal(out[..., 0], out[..., 3])
    model = simulator.model
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="Euler", friction=0, solver=""))
    data = mujoco.MjData(model)
    data.qpos[:] = inputs.initial_values[0, :2].numpy()
    data.qvel[:] = inputs.initial_values[0, 2:].numpy()
    for step in range(10):
        data.ctrl[:] = inputs.actions[0, step].numpy()
        mujoco.mj_step(model, data, nstep=substeps)
        imu = data.sensor("imu").data[0]
        mujoco.mj_step1(model, data)
        expected = [data.qpos[0], data.sensor("gyro").data[1], imu]
        np.testing.assert_allclose(out[0, step, :3].numpy(), expected, rtol=0, atol=1e-12)


def test_divergence_costs_its_own_draw_only(caplog, tmp_path):
    simulator = arm(parameters={"damping": "joint shoulder damping"}, integrator="RK4")
    inputs = random_inputs(simulator)
    draws = torch.tensor([0.2, -1e7, 0.3], dtype=torch.float64)
    for attached in ((), (Bias("shoulder_torque"),)):
        caplog.clear()
        mujoco_open_loop._DIVERGED.clear()
        out = simulator.with_effects(*attached).simulate({"damping": draws}, inputs)
        alone = simulator.simulate({"damping": draws[[0, 2]]}, inputs)
        assert torch.equal(out[[0, 2]], alone)
        assert out[1, 0].isnan().any(-1)[-1]
        assert (out[1][~inputs.mask] == 0.0).all()
        assert len(caplog.records) == 1
        assert "diverged" in caplog.text
        simulator.simulate({"damping": draws}, inputs)
        assert len(caplog.records) == 1
    # The engine's own log would land in the user's folder.
    assert not list(tmp_path.iterdir())


def test_the_pose_of_what_is_no_state_comes_from_a_keyframe():
    simulator = arm(states=["elbow", "elbow_velocity"], keyframe="raised")
    whole = arm()
    inputs = random_inputs(whole, num_segments=1)
    inputs.initial_values[:, 0], inputs.initial_values[:, 2] = 0.4, 0.0
    chosen = inputs.select_channels(["elbow", "elbow_velocity"])
    assert torch.equal(simulator.simulate({}, chosen), whole.simulate({}, inputs)[..., [1, 3]])


def test_rates_are_estimated_from_positions():
    simulator = arm()
    inputs = random_inputs(simulator).select_channels(["shoulder", "elbow"])
    with pytest.raises(DataError, match="shoulder_velocity was not recorded"):
        simulator.simulate({}, inputs)
    rates = Inputs(**{**vars(inputs), "initial_rates": torch.ones_like(inputs.initial_values)})
    assert simulator.simulate({}, rates).isfinite().all()


def test_a_file_without_actuators_swings_by_itself():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.1"/></body></worldbody></mujoco>"""
    )
    simulator = MujocoSimulator(model)
    assert [state.name for state in simulator.states] == ["joint_0", "joint_0_velocity"]
    assert simulator.actions == ()
    assert simulator.joints == ("joint_0_torque",)
    inputs = random_inputs(simulator)
    out = simulator.simulate({}, inputs)
    assert (out[inputs.mask].abs().sum(-1) > 0.0).all()
    effect = CoulombFriction("joint_0_torque")
    assert torch.equal(simulator.with_effects(effect).simulate({}, inputs), out)


# In a Pyro model.


@pytest.mark.slow
def test_inference_end_to_end():
    simulator = arm(parameters={"hand": "body hand mass", "damping": "joint elbow damping"})

    def model(inputs):
        hand = pyro.sample("hand", dist.Uniform(0.1, 1.0))
        damping = pyro.sample("damping", dist.Uniform(0.0, 0.2))
        return npdr.simulate("trajectory", simulator, {"hand": hand, "damping": damping}, inputs)

    inputs = random_inputs(simulator, num_segments=1, num_steps=120, past=0)
    truth = {"hand": value(0.6), "damping": value(0.08)}
    states = torch.cat((inputs.initial_values, simulator.simulate(truth, inputs)[0]))
    rollouts = npdr.Rollouts(
        readings=[states.numpy()],
        actions=[inputs.actions[0].clamp(-3.0, 3.0).numpy()],
        channel_names=inputs.channel_names,
        action_names=inputs.action_names,
        time_step=0.002,
    )
    posterior = npdr.infer(model, rollouts, backend="abc", num_simulations=300, seed=0)
    draws = posterior.sample(200)
    assert draws["hand"].mean() == pytest.approx(0.6, abs=0.1)
    assert draws["hand"].std() < 0.2
    # Without simulations, because the file tells its inverse dynamics.
    regressed = npdr.infer(model, rollouts, backend="bayesian-linear-regression", seed=0)
    draws = regressed.sample(200)
    assert draws["hand"].mean() == pytest.approx(0.6, abs=0.05)
    assert draws["damping"].mean() == pytest.approx(0.08, abs=0.05)


# Inverse dynamics, copies and threads.


def test_inverse_dynamics_hold_along_a_simulation():
    simulator = arm(
        integrator="RK4",
        parameters={
            "hand": "body hand mass",
            "friction": "joint elbow damping",
            "armature": "joint elbow armature",
            "factor": Scale("body upper mass", "body upper inertia"),
        },
    )
    dynamics = simulator.inverse_dynamics
    assert dynamics is not None
    assert dynamics.determined == ("hand", "friction", "armature", "factor")
    assert dynamics.positive == ("hand", "factor")
    assert dynamics.non_negative == ("friction", "armature")
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="RK4", friction=0, solver=""))
    truth = {"hand": 0.7, "friction": 0.1, "armature": 0.02, "factor": 1.3}
    upper, hand = model.body("upper").id, model.body("hand").id
    model.body_mass[hand], model.dof_damping[1], model.dof_armature[1] = 0.7, 0.1, 0.02
    model.body_mass[upper] *= 1.3
    model.body_inertia[upper] *= 1.3
    mujoco.mj_setConst(model, mujoco.MjData(model))
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    rows = []
    for _ in range(20):
        data.qpos[:], data.qvel[:] = rng.normal(size=2), rng.normal(size=2)
        data.ctrl[:] = rng.uniform(-1, 1, 2)
        mujoco.mj_forward(model, data)
        rows.append(np.concatenate((data.qpos, data.qvel, data.qacc, data.ctrl)))
    columns = torch.tensor(np.array(rows)).unbind(-1)
    motion = Motion(columns[:2], columns[2:4], columns[4:6], columns[6:])
    base = dynamics.to_base({name: value(v) for name, v in truth.items()})
    left = dynamics.regressors(motion) @ base
    torch.testing.assert_close(left, dynamics.targets(motion), rtol=1e-9, atol=1e-9)
    back = dynamics.to_physical(base, {})
    assert {name: float(v) for name, v in back.items()} == truth


def test_inverse_dynamics_do_not_contain_how_far_friction_yields():
    friction = {"friction": "joint elbow frictionloss", "hand": "body hand mass"}
    softness = {"softness": "joint * friction_softness"}
    without = arm(friction=0.1, parameters=friction).inverse_dynamics
    found = arm(friction=0.1, parameters=softness | friction).inverse_dynamics
    assert found is not None and without is not None
    assert found.determined == without.determined == ("friction", "hand")
    generator = torch.Generator().manual_seed(0)
    columns = torch.randn(8, 20, generator=generator, dtype=torch.float64).unbind(0)
    motion = Motion(columns[:2], columns[2:4], columns[4:6], columns[6:])
    assert torch.equal(found.regressors(motion), without.regressors(motion))
    assert torch.equal(found.targets(motion), without.targets(motion))
    assert arm(friction=0.1, parameters=softness).inverse_dynamics is None
    both = {"both": Scale("joint elbow frictionloss", "joint elbow friction_softness")}
    both |= {"hand": "body hand mass"}
    assert arm(friction=0.1, parameters=both).inverse_dynamics is None


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"gravity": "option gravity"},
        {"gear": "actuator motor gear"},
        {"length": "body hand position z"},
        {"mass": "body hand mass", "centre": "body hand centre x"},
    ],
)
def test_without_a_linear_form_there_are_no_inverse_dynamics(parameters):
    assert arm(parameters=parameters).inverse_dynamics is None


def test_simulators_travel_between_processes():
    simulator = arm(parameters={"hand": "body hand mass"}).with_effects(Bias("elbow_torque"))
    inputs = random_inputs(simulator)
    copy = pickle.loads(pickle.dumps(simulator))
    given = {"hand": value(0.5), "elbow_torque.bias.offset": value(0.1)}
    assert torch.equal(copy.simulate(given, inputs), simulator.simulate(given, inputs))
    assert simulator.effects != ()
    assert arm().effects == ()


def test_float32_parameters_and_gradients_are_taken_as_numbers():
    simulator = arm(parameters={"hand": "body hand mass"})
    inputs = random_inputs(simulator).to(dtype=torch.float32)
    hand = torch.tensor([0.5], requires_grad=True)
    out = simulator.simulate({"hand": hand}, inputs)
    assert out.dtype == torch.float64
    assert not out.requires_grad
    assert not simulator.is_differentiable
    assert npdr.MujocoSimulator is MujocoSimulator


ROD = """
<mujoco>
  <worldbody>
    <body name="rod">
      {joints}
      <inertial pos="{x} 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="hinge"/></actuator>
</mujoco>
"""
HINGE = '<joint name="hinge" axis="0 1 0"/>'


@pytest.mark.parametrize("num", [1, 100])
def test_a_centre_of_mass_that_is_at_the_joint_in_the_file_can_move(tmp_path, num):
    inputs = Inputs.single(
        torch.ones(20, 1).double(),
        torch.zeros(2).double(),
        action_names=("torque",),
        state_names=("hinge", "hinge_velocity"),
        time_step=0.002,
    )
    for x in (0.0, 0.1):
        (tmp_path / f"{x}.xml").write_text(ROD.format(joints=HINGE, x=x))
    movable = npdr.MujocoSimulator(tmp_path / "0.0.xml", {"centre": "body rod centre x"})
    there = npdr.MujocoSimulator(tmp_path / "0.1.xml", {"mass": "body rod mass"})
    moved = movable.simulate({"centre": torch.full((num,), 0.1).double()}, inputs)
    expected = there.simulate({"mass": torch.ones(1).double()}, inputs)
    assert torch.allclose(moved, expected.expand_as(moved), atol=1e-12)


def test_a_centre_of_mass_at_several_joints_that_would_not_move_is_refused(tmp_path):
    joints = f'<joint name="slide" type="slide" axis="1 0 0"/>{HINGE}'
    (tmp_path / "rod.xml").write_text(ROD.format(joints=joints, x=0.0))
    simulator = npdr.MujocoSimulator(tmp_path / "rod.xml", {"centre": "body rod centre x"})
    inputs = Inputs.single(
        torch.ones(2, 1).double(),
        torch.zeros(4).double(),
        action_names=("torque",),
        state_names=("slide", "slide_velocity", "hinge", "hinge_velocity"),
        time_step=0.002,
    )
    with pytest.raises(ModelError, match="centre of mass of body 'rod' cannot be changed"):
        simulator.simulate({"centre": torch.tensor([0.1]).double()}, inputs)


def test_the_rated_speed_of_a_joint_does_not_depend_on_the_files_pose(tmp_path):
    """An arm that points upwards has almost no inertia about its vertical axis."""
    text = """<mujoco><worldbody><body><joint name="base" axis="0 0 1" range="-180 180"/>
      <geom size="0.05" mass="1"/><body><joint name="shoulder" axis="0 1 0" range="-90 90"/>
      <geom type="capsule" size="0.02" fromto="{pose}" mass="2"/></body></body></worldbody>
      <actuator><motor joint="base" ctrlrange="-10 10"/></actuator></mujoco>"""
    speeds = []
    for pose in ("0 0 0 0 0 1", "0 0 0 1 0 0"):
        (tmp_path / "arm.xml").write_text(text.format(pose=pose))
        speeds.append(MujocoSimulator(tmp_path / "arm.xml", {}).port("base_torque").rated_speed)
    up, along = speeds
    assert up == pytest.approx(along, rel=0.3)
