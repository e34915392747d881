"""Effects in MuJoCo: nothing at zero strength, and the engine's own laws otherwise."""

import mujoco
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.effects import EnvironmentEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    ActuatorGain,
    ActuatorLag,
    Bias,
    Contact,
    CoulombFriction,
    InputDelay,
    JointElasticity,
    Payload,
    SensorDelay,
    SensorLowPass,
    ServoGain,
    Tilt,
    ViscousFriction,
    candidate_effects,
    effects,
)
from tests.helpers.mujoco_files import (
    GYMNASIUM,
    HARD,
    ROLLING,
    arm,
    needs_gymnasium,
    no_strength,
    random_inputs,
    value,
)


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """The engine writes its own warnings to a file in the present folder."""
    monkeypatch.chdir(tmp_path)


def loaded_arm(**options):
    """An arm with a parameter that may drift."""
    return arm(parameters={"hand": "body hand mass", "friction": "joint elbow damping"}, **options)


def rolling(**options):
    """A cylinder on the floor."""
    return MujocoSimulator(mujoco.MjModel.from_xml_string(ROLLING), **options)


CASES = tuple(
    pytest.param(build, effect, id=f"{build.__name__}-{effect.name}")
    for build in (loaded_arm, rolling)
    for effect in candidate_effects(build())
    if build is loaded_arm or isinstance(effect, EnvironmentEffect)
)


def test_every_effect_has_a_case():
    # What adds a joint needs a file; see test_second_joints.
    assert {case.values[1].id for case in CASES} == set(effects()) - {"base_compliance"}


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize(("build", "effect"), CASES)
def test_zero_strength_changes_no_bit(build, effect, integrator):
    base = build()
    base.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    inputs = random_inputs(base, num_steps=12)
    expected = base.simulate({}, inputs)
    changed = base.with_effects(effect)
    assert torch.equal(changed.simulate({}, inputs), expected)
    assert torch.equal(changed.simulate(no_strength(effect), inputs), expected)
    batch = changed.simulate(no_strength(effect, (2, 1)), inputs)
    assert torch.equal(batch, expected.expand(2, 1, *expected.shape))


@pytest.mark.parametrize("effect", [c.values[1] for c in CASES if c.values[0] is loaded_arm])
def test_zero_strength_changes_no_bit_in_other_domains(effect):
    base = loaded_arm(friction=0.01)
    inputs = random_inputs(base, num_steps=6)
    heavy = {"hand": value([0.5, 1.0])}
    changed = base.with_effects(effect)
    assert torch.equal(
        changed.simulate({**heavy, **no_strength(effect)}, inputs), base.simulate(heavy, inputs)
    )


@needs_gymnasium
@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "ant"])
def test_zero_strength_changes_no_bit_in_files_of_others(name):
    base = MujocoSimulator(GYMNASIUM / f"{name}.xml")
    inputs = random_inputs(base, num_segments=1)
    joint, action = base.joints[-1], base.actions[-1].name
    sensor = base.sensors[-1].name
    attached = (
        Tilt("gravity"),
        CoulombFriction(joint),
        Bias(joint),
        InputDelay(action),
        ActuatorLag(action),
        SensorLowPass(sensor),
        SensorDelay(",".join(channel.name for channel in base.sensors)),
        JointElasticity(joint),
        *(Payload(p.name) for p in base.ports if p.unit == "kg"),
        Contact("contact"),
    )
    zero = {}
    for effect in attached:
        zero |= no_strength(effect)
    expected = base.simulate({}, inputs)
    assert torch.equal(base.with_effects(*attached).simulate(zero, inputs), expected)


def draws(effect, simulator, num_draws):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return {
            f"{effect.name}.{name}": prior.sample((num_draws,)).double()
            for name, prior in effect.priors(simulator.port(effect.port)).items()
        }


@pytest.mark.parametrize(("build", "effect"), CASES)
def test_prior_draws_matter_stay_finite_and_do_not_depend_on_the_batch(build, effect):
    base = build()
    changed = base.with_effects(effect)
    given = draws(effect, changed, 10)
    inputs = random_inputs(base, num_steps=100)
    out = changed.simulate(given, inputs)
    assert out.isfinite().all()
    assert (
        (out - base.simulate({}, inputs)).abs().flatten(1).amax(1) > 1e-12
    ).float().mean() > 0.9
    for k in (0, 7):
        alone = changed.simulate({name: x[k] for name, x in given.items()}, inputs)
        assert torch.equal(alone, out[k])


def test_dry_friction_is_the_engines_own():
    """The effect equals the file's friction loss under the same solver parameters."""
    inputs = random_inputs(arm())
    effect = CoulombFriction("shoulder_torque")
    magnitude = value([0.02, 0.3])
    out = (
        arm()
        .with_effects(effect)
        .simulate({"shoulder_torque.coulomb_friction.magnitude": magnitude}, inputs)
    )
    native = arm(solver=HARD, parameters={"friction": "joint shoulder frictionloss"})
    assert torch.equal(out, native.simulate({"friction": magnitude}, inputs))
    # It adds to the file's own, which keeps its solver parameters.
    added = (
        arm(friction=0.1)
        .with_effects(effect)
        .simulate({"shoulder_torque.coulomb_friction.magnitude": magnitude}, inputs)
    )
    native = arm(friction=0.1, parameters={"friction": "joint shoulder frictionloss"})
    assert torch.equal(added, native.simulate({"friction": 0.1 + magnitude}, inputs))


def test_dry_friction_holds_the_joint_at_rest():
    inputs = random_inputs(arm(), num_segments=1, num_steps=100)
    still = torch.tensor([[0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    inputs = Inputs(**{**vars(inputs), "actions": 0 * inputs.actions, "initial_values": still})
    effect = CoulombFriction("shoulder_torque")
    strength = {f"{effect.name}.magnitude": value([0.0, 50.0])}
    out = arm().with_effects(effect).simulate(strength, inputs)
    assert (out[0, 0, :, 0] - 0.3).abs().max() > 0.1
    assert (out[1, 0, :, 0] - 0.3).abs().max() < 1e-3


def test_viscous_friction_converges_to_the_engines_damping():
    errors = []
    native = arm(integrator="RK4", parameters={"damping": "joint shoulder damping"})
    inputs = random_inputs(native, num_segments=1, num_steps=100)
    truth = arm(
        integrator="RK4", parameters={"damping": "joint shoulder damping"}, substeps=8,
        time_step=0.002,
    ).simulate({"damping": value(0.5)}, inputs)  # fmt: skip
    for substeps in (1, 4):
        simulator = arm(integrator="RK4", substeps=substeps, time_step=0.002)
        effect = ViscousFriction("shoulder_torque")
        out = simulator.with_effects(effect).simulate(
            {f"{effect.name}.damping": value(0.3)}, inputs
        )
        errors.append(float((out - truth).abs().max()))
    assert errors[0] < 0.05 * float((truth - native.simulate({}, inputs)).abs().max())
    assert errors[1] < errors[0] / 3.0


def test_gains_may_exceed_the_control_range():
    simulator = arm(parameters={"gear": "actuator motor gear"})
    inputs = random_inputs(simulator)
    gain = simulator.with_effects(ActuatorGain("motor"))
    out = gain.simulate({"motor.actuator_gain.error": value(0.25)}, inputs)
    torch.testing.assert_close(out, simulator.simulate({"gear": value(2.5)}, inputs))


@pytest.mark.parametrize("servo", ['position kp="{:.17g}" kv="0.3"', 'velocity kv="{:.17g}"'])
def test_a_servo_gain_is_that_of_the_file(servo):
    def arm_with(gain):
        text = f"""<mujoco><worldbody><body><joint name="j" axis="0 1 0" armature="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body></worldbody>
        <actuator><{servo.format(gain)} name="servo" joint="j" gear="2"/></actuator></mujoco>"""
        return MujocoSimulator(mujoco.MjModel.from_xml_string(text))

    changed = arm_with(4.0).with_effects(ServoGain("servo"))
    inputs = random_inputs(changed, num_steps=50)
    given = {"servo.servo_gain.error": value([0.0, 0.25])}
    out = changed.simulate(given, inputs)
    assert torch.equal(out[0], arm_with(4.0).simulate({}, inputs))
    torch.testing.assert_close(out[1], arm_with(5.0).simulate({}, inputs), atol=1e-12, rtol=0.0)


def test_a_servo_gain_scales_a_gain_that_is_a_parameter():
    base = arm(parameters={"kp": "actuator elbow_command kp"})
    changed = base.with_effects(ServoGain("elbow_command"))
    inputs = random_inputs(base)
    scaled = changed.simulate(
        {"kp": value(4.0), "elbow_command.servo_gain.error": value(0.5)}, inputs
    )
    torch.testing.assert_close(scaled, base.simulate({"kp": value(6.0)}, inputs))


def test_a_shared_delay_is_the_same_delay_of_each_command():
    text = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
    <body pos="0.2 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1"/></body></body>
    </worldbody><actuator><motor name="one" joint="a"/><motor name="two" joint="b"/></actuator>
    </mujoco>"""
    base = MujocoSimulator(mujoco.MjModel.from_xml_string(text))
    inputs = random_inputs(base)
    delay = value([0.0, 1.3e-3, 4.7e-3])
    together = base.with_effects(InputDelay("one,two"))
    each = base.with_effects(InputDelay("one"), InputDelay("two"))
    torch.testing.assert_close(
        together.simulate({"one,two.input_delay.delay": delay}, inputs),
        each.simulate({"one.input_delay.delay": delay, "two.input_delay.delay": delay}, inputs),
        atol=0.0,
        rtol=0.0,
    )
