"""MuJoCo as a simulator against the equations of the Furuta pendulum, in open and closed loop."""

from dataclasses import replace

import pytest
import torch

from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.loop.control_task import control_task
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.policy_optimisation import returns_of
from npdr_ppl.models.effects import (
    ActuatorLag,
    Backlash,
    ClockSkew,
    CoulombFriction,
    EncoderBias,
    InputDelay,
    ParameterDrift,
    Payload,
    SensorDelay,
    SensorLowPass,
    Tilt,
    ViscousFriction,
)
from npdr_ppl.models.furuta import Furuta, SwingUpReward
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from tests.helpers.mujoco_files import (
    arm,
    furuta_domains,
    furuta_in_mujoco,
    furuta_inputs,
    value,
)


def test_furuta_declares_what_the_ode_model_declares():
    simulator, ode = furuta_in_mujoco(), Furuta()
    assert simulator.actions == ode.actions
    assert simulator.states == ode.states
    assert {p.name for p in simulator.ports} == {p.name for p in ode.ports}
    for port in ode.ports:
        derived = simulator.port(port.name)
        assert (derived.kind, derived.unit) == (port.kind, port.unit)
        # A payload of a file is rated by all that moves with it: arm and pole.
        rated = 0.095 + 0.024 if port.name == "payload" else port.rated
        assert derived.rated == pytest.approx(rated, rel=2.5)
        assert 0.5 < derived.rated_speed / port.rated_speed < 2.0
    for parameter, expected in zip(simulator.parameters, ode.parameters, strict=True):
        assert (parameter.name, parameter.unit) == (expected.name, expected.unit)
        assert parameter.nominal == pytest.approx(expected.nominal)


def test_furuta_follows_the_equations_to_integration_error():
    domains, inputs = furuta_domains(), furuta_inputs(150)
    truth = Furuta(integrator="rk4", substeps=16, compile="never").simulate(domains, inputs)
    errors = []
    for substeps in (1, 2, 4):
        out = furuta_in_mujoco(substeps=substeps).simulate(domains, inputs)
        assert out.shape == truth.shape == (4, 1, 150, 4)
        assert out.dtype == torch.float64
        errors.append(float((out - truth).abs().amax()))
    # Runge-Kutta of the fourth order: halving the step leaves a sixteenth.
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 8.0
    assert errors[2] < errors[1] / 8.0 or errors[2] < 2e-7


ODE = Furuta(integrator="rk4", substeps=16, compile="never")


@pytest.fixture(scope="module")
def without_effects():
    return ODE.simulate({}, furuta_inputs(100))


@pytest.mark.parametrize(
    ("attached", "strengths", "order"),
    [
        (
            (CoulombFriction("arm"), CoulombFriction("pole")),
            {"arm.coulomb_friction.magnitude": 1e-3, "pole.coulomb_friction.magnitude": 2e-4},
            1,
        ),
        ((ViscousFriction("arm"),), {"arm.viscous_friction.damping": 2e-4}, 1),
        ((Tilt("gravity"),), {"gravity.tilt.roll": 0.05, "gravity.tilt.pitch": -0.03}, 4),
        ((InputDelay("voltage"),), {"voltage.input_delay.delay": 0.0073}, 4),
        (
            (SensorLowPass("arm_velocity,pole_velocity"), EncoderBias("pole_angle")),
            {
                "arm_velocity,pole_velocity.sensor_low_pass.time_constant": 0.01,
                "pole_angle.encoder_bias.offset": 0.02,
            },
            4,
        ),
    ],
    ids=["dry friction", "viscous friction", "tilt", "delay", "sensors"],
)
def test_effects_are_those_of_the_ode_engine(attached, strengths, order, without_effects):
    inputs = furuta_inputs(100)
    strengths = {name: value(strength) for name, strength in strengths.items()}
    truth = ODE.with_effects(*attached).simulate(strengths, inputs)
    size = (truth - without_effects).abs().amax()
    errors = []
    for substeps in (2, 8):
        simulator = furuta_in_mujoco(substeps=substeps).with_effects(*attached)
        # All parameters as given, so that the derived fields take the ODE's values.
        out = simulator.simulate(strengths, inputs)
        errors.append(float((out - truth).abs().amax() / size))
    # Forces of effects are held over an engine step: first order. The others are exact.
    if order == 1:
        assert errors[1] < 0.02
        assert errors[1] < errors[0] / 3.0
    else:
        assert errors[1] < 1e-4


# Closed loop.


def test_closed_loop_follows_the_ode_engine():
    states = value([[0.0, 0.1, 0.0, 0.0], [0.02, -0.05, 0.0, 0.1]])
    domains = {"pole_mass": value([[0.022], [0.024], [0.026]])}
    policy = FurutaSwingUp()
    options = {"reward": SwingUpReward(), "record": True}
    truth = Furuta(integrator="rk4", substeps=16, compile="never").roll_out(
        domains, policy, states, 100, **options
    )
    out = furuta_in_mujoco(substeps=4).roll_out(domains, policy, states, 100, **options)
    assert out.readings.shape == (3, 2, 101, 4)
    assert torch.equal(out.lengths, truth.lengths)
    torch.testing.assert_close(out.readings, truth.readings, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(out.returns, truth.returns, rtol=1e-6, atol=0.0)
    # An episode of the loop replays in open loop.
    inputs = Inputs.single(
        out.commands[0, 0],
        states[0],
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=0.002,
    )
    replayed = furuta_in_mujoco(substeps=4).simulate({"pole_mass": value(0.022)}, inputs)
    assert torch.equal(replayed[0], out.readings[0, 0, 1:])


def test_closed_loop_sees_readings_and_ends_at_bounds():
    simulator = furuta_in_mujoco(substeps=1)
    states = value([[0.0, 0.1, 0.0, 0.0], [1.99, 0.1, 15.0, 0.0]])
    policy = FurutaSwingUp()
    plain = simulator.roll_out({}, policy, states, 60, record=True)
    assert plain.returns is None
    assert plain.lengths[0] == 60
    assert plain.lengths[1] < 10
    assert (plain.readings[1, int(plain.lengths[1]) + 1 :] == 0.0).all()
    attached = (
        EncoderBias("pole_angle"),
        CoulombFriction("arm"),
        ActuatorLag("voltage"),
        SensorDelay("arm_angle,arm_velocity"),
        ClockSkew("clock"),
        Backlash("arm"),
        ParameterDrift("arm_damping"),
        Payload("payload"),
    )
    changed = simulator.with_effects(*attached)
    same = changed.roll_out({}, policy, states, 60, record=True)
    assert torch.equal(same.readings, plain.readings)
    biased = {"pole_angle.encoder_bias.offset": value([0.0, 0.05])[:, None]}
    out = changed.roll_out(biased, policy, states, 60, record=True)
    assert out.readings.shape == (2, 2, 61, 4)
    assert torch.equal(out.readings[0], plain.readings)
    assert not torch.equal(out.commands[1, 0], out.commands[0, 0])


def test_policies_that_do_not_fit_are_named():
    with pytest.raises(ModelError, match="do not fit together"):
        arm().roll_out({}, FurutaSwingUp(), torch.zeros(4), 3)


def test_policies_are_trained_in_it():
    task = replace(control_task("furuta-swing-up"), num_steps=60)
    candidates = task.policy.parameters * torch.tensor([[1.0], [1.1]])
    masses = {"pole_mass": torch.tensor([0.022, 0.026])}
    states = task.initial_states(2, torch.Generator().manual_seed(0))
    found = [
        returns_of(task, Domains(simulator, masses), candidates, states)
        for simulator in (furuta_in_mujoco(substeps=1), Furuta(integrator="rk4"))
    ]
    assert found[0].shape == (2, 2, 2)
    torch.testing.assert_close(found[0].float(), found[1].float(), rtol=1e-3, atol=0.0)
