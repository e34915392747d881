"""The catalogue's laws on two engines: the same on both, and MuJoCo's own where it has them."""

import functools
import math
from dataclasses import replace

import mujoco
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    ActuatorLag,
    CoulombFriction,
    JointElasticity,
    ParameterDrift,
    Payload,
    Saturation,
    Spring,
    Tilt,
    ViscousFriction,
    candidate_effects,
)
from npdr_ppl.models.pendulum import Pendulum

# The zoo's pendulum: a uniform rod of 1 kg and 1 m, hanging at zero.
ROD = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4" gravity="{gravity}"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 -1 0" {joint}/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>
    </body>
    {more}
  </worldbody>
  {sections}
  <actuator>{actuator}</actuator>
</mujoco>
"""
MOTOR = '<motor name="torque" joint="hinge" ctrlrange="-4.5 4.5"/>'
SUBSTEPS = 20


def rod(
    *,
    joint="",
    actuator=MOTOR,
    gravity="0 0 -9.81",
    inertia=1.0 / 12.0,
    more="",
    sections="",
    **options,
):
    text = ROD.format(
        joint=joint,
        actuator=actuator,
        gravity=gravity,
        inertia=inertia,
        more=more,
        sections=sections,
    )
    return MujocoSimulator(
        mujoco.MjModel.from_xml_string(text),
        states={"angle": "hinge", "velocity": "hinge_velocity"},
        time_step=Pendulum.time_step,
        **options,
    )


def equations():
    return Pendulum(integrator="rk4", substeps=SUBSTEPS, compile="never")


def swing(*, num_steps=100, start=0, amplitude=3.0, state=(0.5, 1.0)):
    """Commands that change every tenth of a second."""
    generator = torch.Generator().manual_seed(4)
    levels = amplitude * torch.randn(num_steps // 5, generator=generator, dtype=torch.float64)
    inputs = Inputs.single(
        levels.repeat_interleave(5)[:, None],
        torch.tensor(state, dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=Pendulum.time_step,
    )
    return replace(inputs, start=torch.tensor([start]))


def numbers(values):
    return {name: torch.tensor(x, dtype=torch.float64) for name, x in values.items()}


def shared_effects():
    """Every effect at a port that both simulators have; a payload does not sit in one place."""
    others = {
        effect.name
        for effect in candidate_effects(rod(parameters={"damping": "joint hinge damping"}))
    }
    found = [e for e in candidate_effects(equations()) if e.name in others and e.id != "payload"]
    return [*found, ParameterDrift("damping")]


DAMPED = {"damping": 0.1}


@functools.cache
def without_effects(is_mine, finer):
    """What an engine makes of the swing below, the same for every effect."""
    simulator = rod(parameters={"damping": "joint hinge damping"}) if is_mine else equations()
    simulator = simulator.with_finer_steps() if finer else simulator
    return simulator.simulate(numbers(DAMPED), swing(start=100))


@pytest.mark.parametrize("effect", shared_effects(), ids=lambda effect: effect.name)
def test_an_effect_is_the_same_on_both_engines(effect):
    """Up to the engine's hold of forces over a step of 1 ms, and what that does to friction."""
    inputs = swing(start=100)
    mine, finer = rod(parameters={"damping": "joint hinge damping"}), False
    port = equations().port(effect.port)
    probe = {f"{effect.name}.{name}": x for name, x in effect.probe(port).items()}
    if effect.id == "stribeck_friction":
        # Otherwise the pendulum is through the region near rest within a few engine steps.
        probe["hinge.stribeck_friction.speed"] = 2.0
        # The engine holds what changes with speed for a step; the equations take its middle.
        mine, finer = mine.with_finer_steps(), True
    if effect.id == "parameter_drift":
        probe = {"damping.parameter_drift.rate": 0.2}
    both = []
    for simulator, base in (
        (equations(), without_effects(is_mine=False, finer=False)),
        (mine, without_effects(is_mine=True, finer=finer)),
    ):
        changed = simulator.with_effects(effect).simulate(numbers(DAMPED | probe), inputs)
        both.append(changed - base)
    size = both[0].abs().amax((0, 1))
    assert (size > 0.0).any()
    error = (both[1] - both[0]).abs().amax((0, 1))
    assert (error <= 0.01 * size + 1e-9).all(), (error / size, size)


NATIVE = {
    "coulomb": (
        CoulombFriction("hinge"),
        {"magnitude": 0.4},
        {
            "joint": 'frictionloss="0.4" solreffriction="0.002 1" '
            'solimpfriction="0.9999 0.9999 0.001 0.5 2"'
        },
    ),
    "viscous": (ViscousFriction("hinge"), {"damping": 0.3}, {"joint": 'damping="0.3"'}),
    "spring": (
        Spring("hinge"),
        {"stiffness": 2.0, "rest": 0.3},
        # The rod's inertia about its centre as an armature, with which it is the same rod.
        {
            "joint": 'stiffness="2" springref="0.3" armature="0.08333333333333333"',
            "inertia": 1e-9,
        },
    ),
    "saturation": (
        Saturation("torque"),
        {"limit": 2.0},
        {"actuator": MOTOR.replace("/>", ' forcerange="-2 2"/>')},
    ),
    "lag": (
        ActuatorLag("torque"),
        {"time_constant": 0.05},
        {
            "actuator": '<general name="torque" joint="hinge" ctrlrange="-4.5 4.5" '
            'dyntype="filterexact" dynprm="0.05" gainprm="1"/>'
        },
    ),
    "tilt": (
        Tilt("gravity"),
        {"roll": 0.0, "pitch": 0.1},
        {"gravity": f"{-9.81 * math.sin(0.1)} 0 {-9.81 * math.cos(0.1)}"},
    ),
}


@pytest.mark.parametrize("name", NATIVE)
def test_laws_are_those_that_the_engine_has_of_its_own(name):
    effect, values, native = NATIVE[name]
    inputs = swing()
    given = {f"{effect.name}.{key}": x for key, x in values.items()}
    out = equations().with_effects(effect).simulate(numbers(given), inputs)
    truth = rod(**native).simulate({}, inputs)
    size = (truth - equations().simulate({}, inputs)).abs().amax((0, 1))
    error = (out - truth).abs().amax((0, 1))
    # Lags differ by what the command does within a step of 20 ms, of which its mean is taken.
    tolerance = {"lag": 0.03, "coulomb": 0.01}.get(name, 1e-3)
    assert (error < tolerance * size).all(), error / size


def test_joint_elasticity_is_two_bodies_with_a_spring_between_them():
    share, frequency, ratio = 0.4, 2.0 * math.pi * 6.0, 0.1
    total = 1.0 / 3.0
    motor, link = share * total, (1.0 - share) * total
    reduced = motor * link / total
    stiffness, damping = reduced * frequency**2, 2.0 * ratio * reduced * frequency
    # The link has the rod's weight, and what is left of the rod's inertia about the hinge.
    tendon = (
        f'<tendon><fixed stiffness="{stiffness}" damping="{damping}" springlength="0">'
        '<joint joint="motor" coef="1"/><joint joint="hinge" coef="-1"/></fixed></tendon>'
    )
    rotor = (
        '<body><joint name="motor" axis="0 -1 0"/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{motor} {motor} {motor}"/></body>'
    )
    # A mass of 1 kg half a metre out has more inertia than the link, so it is nearer and heavier.
    text = ROD.format(
        joint="",
        actuator=MOTOR.replace("hinge", "motor"),
        gravity="0 0 -9.81",
        inertia=1e-9,
        more=rotor,
        sections=tendon,
    ).replace('pos="0 0 -0.5" mass="1"', f'pos="0 0 {-link / 0.5}" mass="{0.25 / link}"')
    truth = MujocoSimulator(
        mujoco.MjModel.from_xml_string(text),
        states={
            "angle": "hinge",
            "turn": "motor",
            "velocity": "hinge_velocity",
            "speed": "motor_velocity",
        },
        sensors={"angle": "angle", "velocity": "velocity"},
        time_step=Pendulum.time_step,
    )
    inputs = swing(state=(0.0, 0.0))
    two = Inputs.single(
        inputs.actions[0],
        torch.zeros(4, dtype=torch.float64),
        action_names=("torque",),
        state_names=tuple(state.name for state in truth.states),
        time_step=Pendulum.time_step,
    )
    # A segment starts with the spring settled under its first command, here none.
    two.actions[:, :5] = inputs.actions[:, :5] = 0.0
    expected = truth.simulate({}, two)
    effect = JointElasticity("hinge")
    given = numbers(
        {
            f"{effect.name}.time_constant": 1.0 / frequency,
            f"{effect.name}.damping_ratio": ratio,
            f"{effect.name}.motor_share": share,
        }
    )
    for simulator in (equations(), rod()):
        rigid = simulator.simulate({}, inputs)
        out = simulator.with_effects(effect).simulate(given, inputs)
        size = (expected - rigid).abs().amax((0, 1))
        assert ((out - expected).abs().amax((0, 1)) < 0.03 * size).all()


def test_a_payload_is_the_bodys_mass():
    inputs, mass = swing(), torch.tensor([0.0, 0.3, 1.2], dtype=torch.float64)
    out = rod().with_effects(Payload("payload")).simulate({"payload.payload.mass": mass}, inputs)
    native = rod(parameters={"mass": "body rod mass"})
    assert torch.equal(out, native.simulate({"mass": 1.0 + mass}, inputs))
