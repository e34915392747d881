"""Effects against closed forms, on systems simple enough to have them."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import lsim

from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.effects import (
    AsymmetricCoulombFriction,
    Backlash,
    Bias,
    Cogging,
    Contact,
    CoulombFriction,
    FrictionDrift,
    JointElasticity,
    LoadDependentFriction,
    ParameterDrift,
    Payload,
    PeriodicDisturbance,
    PreslidingFriction,
    QuadraticDrag,
    Quantisation,
    Saturation,
    SensorLowPass,
    ViscousFriction,
    Wind,
)
from npdr_ppl.models.emps import Emps
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum
from tests.helpers.effect_replay import FREE, replay


def test_presliding_friction_slides_like_coulomb_friction():
    simulator = Emps().with_effects(PreslidingFriction("carriage"))
    for drive in (3.0, -3.0):
        parameters = FREE | {
            "viscous_friction": 4.0,
            "carriage.presliding_friction.magnitude": 1.0,
            "carriage.presliding_friction.deflection": 1e-3,
        }
        out = replay(simulator, parameters, torch.full((4000,), drive))
        assert out[-1, 1].item() == pytest.approx(drive / 3.0 * (3.0 - 1.0) / 4.0, rel=1e-6)


def test_presliding_friction_holds_like_a_bent_bristle():
    """Under a force below F, Dahl's law comes to rest at z = −z_s log(1 − force/F)."""
    simulator = Emps().with_effects(PreslidingFriction("carriage"))
    parameters = FREE | {
        "viscous_friction": 200.0,
        "carriage.presliding_friction.magnitude": 2.0,
        "carriage.presliding_friction.deflection": 1e-3,
        "carriage.presliding_friction.relaxation": 0.0,
    }
    ramp = torch.linspace(0.0, 1.0, 6000)
    drive = torch.cat((ramp, torch.ones(4000)))
    out = replay(simulator, parameters, drive)
    assert out[-1, 0].item() == pytest.approx(1e-3 * math.log(2.0), rel=1e-3)
    assert abs(out[-1, 1].item()) < 1e-9


@pytest.mark.parametrize("stiffness", [1e2, 1e6, 1e10])
@pytest.mark.parametrize("velocity", [-0.3, 0.0, 1e-4, 0.3])
@pytest.mark.parametrize("relaxation", [0.0, 3e-3])
def test_presliding_friction_solves_its_implicit_step(stiffness, velocity, relaxation):
    magnitude, step = 2.0, 1e-3
    values = {
        "magnitude": magnitude,
        "deflection": magnitude / stiffness,
        "relaxation": relaxation,
    }
    parameters = {
        name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()
    }
    for bristles in (-1.0, -0.4, 0.0, 0.9):
        joint = Joint(
            *(torch.tensor([x], dtype=torch.float64) for x in (0.0, velocity, 5.0, 0.5, 0.0))
        )
        memory = (torch.tensor([bristles], dtype=torch.float64), torch.zeros(1).double())
        law = PreslidingFriction("carriage")
        bent, force = law.begin_step(joint, parameters, memory, step)
        moved = step * (velocity + step * (5.0 + 0.5 * force))
        expected = (bristles + moved / parameters["deflection"]) / (
            1.0 + moved.abs() / parameters["deflection"]
        )
        torch.testing.assert_close(bent, expected, rtol=1e-6, atol=1e-9)
        assert bent.abs() <= 1.0


def test_load_dependent_friction_is_coulomb_friction_in_proportion_to_the_motor():
    volts = torch.full((300,), 3.0)
    arm = Furuta().with_effects(LoadDependentFriction("arm"))
    loaded = replay(arm, {"arm.load_dependent_friction.coefficient": 0.1}, volts)
    torque = 0.1 * 3.0 * 0.042 / 8.4
    dry = Furuta().with_effects(CoulombFriction("arm"))
    expected = replay(dry, {"arm.coulomb_friction.magnitude": torque}, volts)
    torch.testing.assert_close(loaded, expected, rtol=1e-8, atol=1e-10)
    # Of three joints or two, the pole of neither bears the drive.
    cart = CartPole().with_effects(LoadDependentFriction("rail"))
    push = torch.full((100,), 5.0)
    loaded = replay(cart, {"rail.load_dependent_friction.coefficient": 0.1}, push)
    dry = CartPole().with_effects(CoulombFriction("rail"))
    expected = replay(dry, {"rail.coulomb_friction.magnitude": 0.5}, push)
    torch.testing.assert_close(loaded, expected, rtol=1e-8, atol=1e-10)


def test_friction_drift_decays_from_cold_to_warm():
    simulator = Emps().with_effects(FrictionDrift("carriage"))
    site = "carriage.friction_drift."
    cold = FREE | {f"{site}dry": 0.5, f"{site}viscous": 0.3, f"{site}time_constant": 20.0}
    push = torch.ones(50)
    both = Emps().with_effects(CoulombFriction("carriage"), ViscousFriction("carriage"))
    for time in (0.0, 30.0):
        left = math.exp(-time / 20.0)
        steady = FREE | {
            "carriage.coulomb_friction.magnitude": 0.5 * left,
            "carriage.viscous_friction.damping": 0.3 * left,
        }
        step = round(time / Emps.time_step)
        out = replay(simulator, cold, push, [0.0, 0.5], step)
        expected = replay(both, steady, push, start=[0.0, 0.5])
        # 50 ms of 20 s change the friction by 0.25 %.
        torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("effect", [PeriodicDisturbance("hinge"), FrictionDrift("hinge")])
def test_segments_carry_on_the_time_of_their_rollout(effect):
    simulator = Pendulum().with_effects(effect)
    parameters = {f"{effect.name}.{n}": 0.7 for n in (p.name for p in effect.parameters)}
    torques = torch.randn(60, generator=torch.Generator().manual_seed(0)).double()
    whole = replay(simulator, parameters, torques, [0.3, 0.0], 0)
    rest = replay(simulator, parameters, torques[25:], whole[24].tolist(), 25)
    torch.testing.assert_close(rest, whole[25:], rtol=1e-9, atol=1e-11)


def test_a_periodic_disturbance_shakes_a_free_mass():
    simulator = Emps(integrator="rk4").with_effects(PeriodicDisturbance("carriage"))
    site = "carriage.periodic_disturbance."
    out = replay(simulator, FREE | {f"{site}cosine": 2.0, f"{site}frequency": 1.5}, [0.0] * 2000)
    omega = 2.0 * math.pi * 1.5
    time = Emps.time_step * torch.arange(1, 2001)
    # The force is held for a step, so the velocity is off by half a step's force at most.
    torch.testing.assert_close(
        out[:, 1], 2.0 / omega * torch.sin(omega * time).double(), rtol=0.0, atol=2.1e-3
    )


def test_cogging_has_its_periods_per_turn():
    law = Cogging("hinge", order=7)
    angles = torch.linspace(0.0, 2.0 * math.pi, 7 * 16 + 1, dtype=torch.float64)
    given = {
        "sine": torch.tensor(0.3, dtype=torch.float64),
        "cosine": torch.tensor(-0.1, dtype=torch.float64),
    }
    force = law.force(angles, angles, given, None)
    torch.testing.assert_close(force[16:], force[:-16])
    spectrum = torch.fft.rfft(force[:-1]).abs()
    assert spectrum.argmax() == 7
    torch.testing.assert_close(force[4], torch.tensor(0.3, dtype=torch.float64))


def test_wind_pushes_at_rest_and_drags_when_it_is_still():
    def force(angle, velocity, **given):
        given = {name: torch.tensor(value, dtype=torch.float64) for name, value in given.items()}
        return Wind("hinge").force(
            torch.tensor(angle, dtype=torch.float64),
            torch.tensor(velocity, dtype=torch.float64),
            given,
            None,
        )

    assert force(0.7, 0.0, force=2.0, speed=5.0, direction=0.7) == 2.0
    assert force(0.7 + math.pi, 0.0, force=2.0, speed=5.0, direction=0.7) == -2.0
    assert force(0.0, 5.0, force=2.0, speed=5.0, direction=0.0) == 0.0
    speed, drag = 1e-6, 0.4
    still = force(0.3, -2.0, force=drag * speed**2, speed=speed, direction=0.0)
    given = {"drag": torch.tensor(drag, dtype=torch.float64)}
    velocity = torch.tensor(-2.0, dtype=torch.float64)
    torch.testing.assert_close(
        still, QuadraticDrag("hinge").force(velocity, velocity, given, None), rtol=1e-5, atol=0.0
    )


def test_saturation_clips_and_an_infinite_limit_does_not():
    volts = torch.linspace(-4.0, 4.0, 100)
    simulator = Furuta().with_effects(Saturation("voltage"))
    out = replay(simulator, {"voltage.saturation.limit": 2.5}, volts)
    assert torch.equal(out, replay(Furuta(), {}, volts.clamp(-2.5, 2.5)))
    assert torch.equal(replay(simulator, {}, volts), replay(Furuta(), {}, volts))


def test_quantised_readings_lie_on_a_grid_around_the_truth():
    count = 2.0 * math.pi / 2048
    volts = torch.linspace(-4.0, 4.0, 100)
    simulator = Furuta().with_effects(Quantisation("arm_angle,pole_angle"))
    out = replay(simulator, {"arm_angle,pole_angle.quantisation.count": count}, volts)
    true = replay(Furuta(), {}, volts)
    torch.testing.assert_close(out[:, :2] / count, (out[:, :2] / count).round())
    assert (out - true)[:, :2].abs().max() <= 0.5 * count
    assert torch.equal(out[:, 2:], true[:, 2:])


def test_backlash_lets_the_link_fly_for_as_long_as_the_motor_takes_across_the_gap():
    play, share, push = 1e-3, 0.25, 2.0
    simulator = Emps().with_effects(Backlash("carriage"))
    site = "carriage.backlash."
    drive = torch.cat((torch.full((200,), push), torch.full((400,), -push)))
    parameters = FREE | {f"{site}play": play, f"{site}motor_share": share}
    velocity = replay(simulator, parameters, drive)[:, 1]
    rigid = replay(Emps(), FREE, drive)[:, 1]
    torch.testing.assert_close(velocity[:200], rigid[:200])
    # The motor alone, of mass share · 1 kg, crosses 2 play against the coasting link.
    flight = math.sqrt(2.0 * 2.0 * play * share / push)
    flying = (velocity[200:] - velocity[199]).abs() < 1e-9
    assert flying.sum().item() == pytest.approx(flight / Emps.time_step, abs=2)
    assert flying[: flying.sum()].all()
    # They meet without a bounce: no momentum is lost.
    torch.testing.assert_close(velocity[-1], rigid[-1], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_gap_is_crossed_within_a_step_as_in_short_ones():
    """So is what damping takes meanwhile from the link, which coasts and has gone less far."""
    play, share, push = 2e-7, 0.35, 2.0
    assert 2.0 * math.sqrt(2.0 * play * share / push) < Emps.time_step  # it takes no longer
    site = "carriage.backlash."
    parameters = FREE | {
        "viscous_friction": 2.0,
        f"{site}play": play,
        f"{site}motor_share": share,
    }
    drive = [push] * 50 + [-push] * 50 + [push] * 50

    def replayed(**options):
        simulator = Emps(integrator="rk4", **options).with_effects(Backlash("carriage"))
        return replay(simulator, parameters, drive)

    coarse, fine = replayed(), replayed(substeps=100)
    torch.testing.assert_close(coarse[:, 0], fine[:, 0], rtol=0.0, atol=0.01 * play * share)
    torch.testing.assert_close(coarse[:, 1], fine[:, 1], rtol=0.0, atol=0.01 * 2.0 * play * share)


def test_an_elastic_joint_rings_at_its_resonance_about_its_centre_of_mass():
    share, time_constant, ratio, push = 0.4, 0.01, 0.1, 2.0
    simulator = Emps().with_effects(JointElasticity("carriage"))
    site = "carriage.joint_elasticity."
    parameters = FREE | {
        f"{site}time_constant": time_constant,
        f"{site}damping_ratio": ratio,
        f"{site}motor_share": share,
    }
    out = replay(simulator, parameters, [0.0] + [push] * 299)[1:, 0]
    time = Emps.time_step * torch.arange(1, 300, dtype=torch.float64)
    omega = 1.0 / time_constant
    swing = omega * math.sqrt(1.0 - ratio**2)
    settled = push / share * time_constant**2  # the pull of 2 N on a motor of 0.4 kg
    decay = torch.exp(-ratio * omega * time)
    ringing = torch.cos(swing * time) + ratio * omega / swing * torch.sin(swing * time)
    link = 0.5 * push * time**2 - share * settled * (1.0 - decay * ringing)
    # Positions are integrated to first order: off by half a step's velocity.
    torch.testing.assert_close(out, link, rtol=0.0, atol=0.6 * Emps.time_step * push * 0.3)
    # Without that error in the difference to the rigid joint.
    rigid = replay(Emps(), FREE, [0.0] + [push] * 299)[1:, 0]
    expected = -share * settled * (1.0 - decay * ringing)
    torch.testing.assert_close(out - rigid, expected, rtol=0.0, atol=0.06 * share * settled)


def test_a_link_swings_about_where_it_would_be_although_steps_are_longer_than_its_period():
    """Its way is known to the step's end, however often it turns round within the step."""
    share, ratio, push = 0.4, 0.1, 2.0
    midpoint = Emps().with_finer_steps()
    time_constant = 0.15 * Emps.time_step
    simulator = midpoint.with_effects(JointElasticity("carriage"))
    site = "carriage.joint_elasticity."
    parameters = FREE | {
        f"{site}time_constant": time_constant,
        f"{site}damping_ratio": ratio,
        f"{site}motor_share": share,
    }
    drive = [0.0] + [push] * 19 + [-push] * 180
    lag = (replay(simulator, parameters, drive) - replay(midpoint, FREE, drive))[:, 0]
    settled = push / share * time_constant**2
    # It ends behind the rigid joint's centre of mass, by the motor's share of what is settled.
    torch.testing.assert_close(lag[-1].item(), share * settled, rtol=1e-6, atol=0.0)
    # Undamped, it would swing as far beyond one rest as the other rest is away.
    assert lag.abs().max() < 3.0 * share * settled


@pytest.mark.parametrize("simulator", [Pendulum(), CartPole(), Furuta(), Emps()])
def test_a_payload_adds_its_inertia_and_weight(simulator):
    """ΔM is the Hessian of the payload's kinetic energy, and its weight that of its height."""
    payload = 0.3
    nominal = {parameter.name: parameter.nominal for parameter in simulator.parameters}

    def tip(q):
        if simulator.name == "Pendulum":
            return nominal["length"] * torch.stack((torch.sin(q[0]), -torch.cos(q[0])))
        if simulator.name == "CartPole":
            length = nominal["pole_length"]
            return torch.stack((q[0] + length * torch.sin(q[1]), -length * torch.cos(q[1])))
        if simulator.name == "Emps":
            return q
        arm, pole = nominal["arm_length"], nominal["pole_length"]
        out = torch.stack((torch.cos(q[0]), torch.sin(q[0]), 0.0 * q[0]))
        along = torch.stack((-torch.sin(q[0]), torch.cos(q[0]), 0.0 * q[0]))
        down = torch.stack((0.0 * q[0], 0.0 * q[0], -torch.ones_like(q[0])))
        return arm * out + pole * (torch.sin(q[1]) * along + torch.cos(q[1]) * down)

    generator = torch.Generator().manual_seed(4)
    q = torch.randn(len(simulator.joints), generator=generator).double()
    jacobian = torch.autograd.functional.jacobian(tip, q)
    weight = torch.zeros_like(q)
    if simulator.name != "Emps":
        weight = -payload * nominal["gravity"] * jacobian[-1]

    def mass_and_force(simulator, parameters):
        given = {
            name: torch.tensor(value, dtype=torch.float64) for name, value in parameters.items()
        }
        complete = simulator.complete(given, torch.float64, torch.device("cpu"))
        tables, _ = simulator.tables(complete, torch.Size((1,)), simulator.time_step)
        zero = (torch.zeros(1).double(),) * len(q)
        position = tuple(x.reshape(1) for x in q)
        rows = simulator.inverse_inertia(position, zero, tables.constants)
        inverse = torch.stack([torch.stack([x.reshape(()) for x in row]) for row in rows])
        action = (torch.zeros(1).double(),)
        a = simulator.accelerations(position, zero, action, (0.0,) * len(q), tables.constants)
        mass = torch.linalg.inv(inverse)
        return mass, mass @ torch.cat(a)

    mass, force = mass_and_force(simulator, {})
    loaded, pulled = mass_and_force(
        simulator.with_effects(Payload("payload")), {"payload.payload.mass": payload}
    )
    torch.testing.assert_close(loaded - mass, payload * jacobian.T @ jacobian)
    torch.testing.assert_close(pulled - force, weight)


def test_contact_coefficients_change_by_factors_and_only_where_the_engine_has_them():
    given = {name: torch.tensor(math.log(2.0)) for name in ("friction", "rolling")}
    given |= {name: torch.tensor(0.0) for name in ("restitution", "compliance")}
    before = {"friction": torch.tensor(0.8), "restitution": torch.tensor(0.3), "margin": 1.0}
    after = Contact("contact").environment(before, given)
    torch.testing.assert_close(after["friction"], torch.tensor(1.6))
    assert torch.equal(after["restitution"], before["restitution"])
    assert after["margin"] == 1.0
    assert set(after) == set(before)


def test_a_drifting_parameter_is_another_one_in_each_segment():
    simulator = Pendulum().with_effects(ParameterDrift("mass"))
    torques = torch.linspace(-1.0, 1.0, 20)
    for step in (0, 3000):
        out = replay(simulator, {"mass.parameter_drift.rate": 1e-3}, torques, [0.5, 0.0], step)
        middle = Pendulum.time_step * (step + 10)
        mass = Pendulum.parameters[0].nominal * (1.0 + 1e-3 * middle)
        expected = replay(Pendulum(), {"mass": mass}, torques, [0.5, 0.0], step)
        torch.testing.assert_close(out, expected, rtol=1e-12, atol=1e-12)


def test_a_bias_is_what_asymmetric_friction_has_over_coulomb_friction():
    """The class {asymmetric Coulomb, Coulomb + bias} in motion: F ± c."""
    push = torch.cat((torch.full((50,), 6.0), torch.full((150,), -6.0)))
    both = Emps().with_effects(CoulombFriction("carriage"), Bias("carriage"))
    one = Emps().with_effects(AsymmetricCoulombFriction("carriage"))
    site = "carriage.asymmetric_coulomb_friction."
    torch.testing.assert_close(
        replay(
            both,
            FREE | {"carriage.coulomb_friction.magnitude": 1.0, "carriage.bias.offset": 0.2},
            push,
        ),
        replay(one, FREE | {f"{site}forward": 0.8, f"{site}backward": 1.2}, push),
        rtol=1e-3,
        atol=1e-3,
    )


@pytest.mark.parametrize("time_step", [0.002, 0.01])
def test_a_filtered_reading_is_the_continuous_filter_of_the_line_between_samples(time_step):
    law, time_constant = SensorLowPass("velocity"), torch.tensor(0.012, dtype=torch.float64)
    times = time_step * np.arange(60)
    true = np.interp(times, [0.0, 0.05, 0.2, 1.0], [0.0, 3.0, -1.0, 5.0])
    expected = lsim(([1.0], [float(time_constant), 1.0]), true, times, X0=[0.0])[1]
    values, own = torch.tensor(true), {"time_constant": time_constant}
    start = Start(torch.zeros(()), time_step, own)
    memory = law.initial_memory(values[0], torch.tensor(0.0).double(), start)
    for value, reading in zip(values[1:], expected[1:], strict=True):
        output, memory = law.read(value, own, memory, time_step)
        assert output.item() == pytest.approx(reading, abs=1e-12)


def test_a_filtered_position_trails_a_parabola_as_the_continuous_filter_does():
    law, own = SensorLowPass("angle"), {"time_constant": torch.tensor(0.012).double()}
    step, (a, b) = 0.02, (0.3, -4.0)  # x = a t + ½ b t², whose filtered value is known
    bend = torch.tensor(-0.5 * b * step**2)
    memory = law.initial_memory(*torch.zeros(2).double(), Start(torch.zeros(()), step, own))
    for k in range(1, 80):
        t, lag = k * step, 0.012
        value = torch.tensor(a * t + 0.5 * b * t * t)
        output, memory = law.read_bent(value, bend, own, memory, step)
    # After the transient: x(t) − T ẋ(t) + T² ẍ.
    assert output.item() == pytest.approx(a * t + 0.5 * b * t * t - lag * (a + b * t) + lag**2 * b)
