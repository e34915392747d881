"""BulletSimulator: an independent engine for the zoo's pendulum, and scenes made by code."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.bullet import BulletSettings, BulletSimulator, Command, Sensor
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.channels import Channel, Parameter
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import Bias, candidate_effects, effects
from npdr_ppl.models.effects.friction import CoulombFriction, ViscousFriction
from npdr_ppl.models.pendulum import Pendulum
from tests.helpers.bullet_models import (
    SENSORS,
    Drop,
    PendulumModel,
    bullet_pendulum,
    pendulum_urdf,
)
from tests.helpers.faulty import FaultRates
from tests.helpers.faulty_simulator import FaultMessenger

STEPS = 100
TIME_STEP = 0.02

PORTS = {
    "force": "hinge", "action": "torque", "sensor": "angle", "environment": "gravity",
    "clock": "clock", "parameter": "mass", "servo": "torque",
}  # fmt: skip

# What needs more of the joint or of rates than Bullet gives, and what needs a port that
# a scene does not have.
REFUSED = {
    "backlash", "base_compliance", "clock_skew", "contact", "joint_elasticity",
    "load_dependent_friction", "offset_payload", "payload", "presliding_friction", "sensor_delay",
    "servo_gain", "servo_force_limit", "servo_dead_band", "servo_integral_action",
    "goal_speed_limit", "goal_acceleration_limit", "goal_resolution",
}  # fmt: skip

# Bullet works in float64 here and its Featherstone dynamics of one joint are the same formula.
ROUNDING = 1e-9


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    return pendulum_urdf(tmp_path_factory.mktemp("urdf"))


@pytest.fixture(scope="module", autouse=True)
def one_worker():
    """Keeps one process for all tests that do not ask for others."""
    with npdr.workers("serial") as used:
        yield used


def inputs(torque=4.5, start=(0.3, 0.0), num_segments=1, steps=STEPS):
    time = TIME_STEP * torch.arange(steps, dtype=torch.float64)
    actions = (torque * torch.sin(2 * math.pi * time))[:, None]
    single = Inputs.single(
        actions, torch.tensor(start, dtype=torch.float64), action_names=("torque",),
        state_names=("angle", "velocity"), time_step=TIME_STEP, history=5,
    )  # fmt: skip
    return single.segments([0] * num_segments)


def tensors(**values):
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


@pytest.mark.slow
def test_a_urdf_pendulum_is_the_zoo_s_pendulum(urdf):
    parameters = tensors(mass=[0.5, 1.0, 1.5], damping=[0.0, 0.1, 0.3])
    for substeps in (1, 4):
        found = bullet_pendulum(urdf, substeps).simulate(parameters, inputs())
        same = Pendulum(integrator="semi-implicit-euler", substeps=substeps)
        expected = same.simulate(parameters, inputs())
        assert found.shape == (3, 1, STEPS, 2)
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING)


@pytest.mark.slow
def test_the_integration_error_is_of_first_order(urdf):
    parameters = tensors(mass=1.2, damping=0.1)
    exact = Pendulum(integrator="rk4", substeps=20).simulate(parameters, inputs())
    errors = [
        float((bullet_pendulum(urdf, n).simulate(parameters, inputs()) - exact).abs().max())
        for n in (2, 4, 8)
    ]
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert 1.7 < coarse / fine < 2.3


def test_parameters_and_ports_are_read_from_the_scene(urdf):
    simulator = bullet_pendulum(urdf)
    nominal = {p.name: (p.nominal, p.unit) for p in simulator.parameters}
    assert nominal == {
        "mass": (1.0, "kg"),
        "damping": (0.02, "N m s/rad"),
        "gravity_strength": (9.81, "m/s²"),
    }
    hinge = simulator.port("hinge")
    assert (hinge.kind, hinge.unit, hinge.rated, hinge.rated_speed) == ("force", "N m", 4.5, 5.0)
    assert {p.name for p in simulator.ports} == {"torque", "hinge", "angle", "velocity", "gravity"}
    assert simulator.recorded_settings()["substeps"] == 1


@pytest.mark.slow
def test_results_do_not_depend_on_workers_or_on_earlier_simulations(urdf):
    simulator = bullet_pendulum(urdf)
    parameters = tensors(mass=np.linspace(0.4, 1.6, 12).tolist(), damping=0.1)
    given = inputs(num_segments=2)
    alone = simulator.simulate(parameters, given)
    with npdr.workers("loky", 2, chunk_size=1):
        spread = simulator.simulate(parameters, given)
    assert torch.equal(alone, spread)
    backwards = {
        name: value.flip(0) if value.dim() else value for name, value in parameters.items()
    }
    assert torch.equal(simulator.simulate(backwards, given), alone.flip(0))


@pytest.mark.parametrize("kind", ["force", "action", "sensor", "environment", "parameter"])
def test_effects_of_zero_strength_change_nothing(urdf, kind):
    simulator = bullet_pendulum(urdf)
    parameters = tensors(mass=[0.8, 1.3])
    base = simulator.simulate(parameters, inputs())
    for effect_id, effect in effects().items():
        if kind in effect.port_kinds and effect_id not in REFUSED:
            changed = simulator.with_effects(effect(PORTS[kind]))
            assert torch.equal(changed.simulate(parameters, inputs()), base), effect.id


@pytest.mark.parametrize("effect_id", sorted(REFUSED))
def test_effects_that_need_more_than_bullet_gives_are_refused_in_one_sentence(urdf, effect_id):
    effect = effects()[effect_id]
    with pytest.raises(ModelError, match=effect_id):
        bullet_pendulum(urdf).with_effects(effect(PORTS[effect.port_kinds[0]]))


def test_candidates_are_what_bullet_takes(urdf):
    simulator = bullet_pendulum(urdf)
    assert simulator.port("hinge").is_driven
    assert {effect.id for effect in candidate_effects(simulator)} == effects().keys() - REFUSED


@pytest.mark.parametrize("effect_id", sorted(effects().keys() - REFUSED))
def test_effects_do_what_they_do_to_the_zoo_s_pendulum(urdf, effect_id):
    effect = effects()[effect_id]
    port = PORTS[effect.port_kinds[0]]
    bullet, ode = bullet_pendulum(urdf), Pendulum(integrator="semi-implicit-euler")
    torch.manual_seed(0)
    priors = effect(port).priors(ode.port(port))
    own = {f"{port}.{effect_id}.{name}": d.sample((3,)).double() for name, d in priors.items()}
    parameters = {**tensors(mass=1.2, damping=0.1), **own}
    # Late in a rollout, for what depends on the time since it began.
    given = replace(inputs(start=(0.5, 1.0)), start=torch.tensor([150]))
    found = bullet.with_effects(effect(port)).simulate(parameters, given)
    expected = ode.with_effects(effect(port)).simulate(parameters, given)
    base = bullet.simulate(tensors(mass=1.2, damping=0.1), given)
    assert (found - base).abs().max() > 1e-4
    # A solver's iterations for dry friction end before rounding does.
    atol = 1e-6 if "coulomb" in effect_id or "stribeck" in effect_id else ROUNDING
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


def test_stiction_holds_a_joint_until_the_load_exceeds_it(urdf):
    simulator = bullet_pendulum(urdf).with_effects(CoulombFriction("hinge"))
    # At 0.3 rad gravity pulls with m g l/2 sin 0.3 = 1.4495 N m.
    parameters = tensors(**{"hinge.coulomb_friction.magnitude": [1.44, 1.46]})
    moved = simulator.simulate(parameters, inputs(torque=0.0))[..., 0] - 0.3
    assert moved[0].abs().max() > 1e-4
    assert moved[1].abs().max() < 1e-9


def test_a_ball_made_by_code_falls_and_bounces():
    given = Inputs.single(
        torch.zeros(60, 0, dtype=torch.float64), torch.tensor([0.4], dtype=torch.float64),
        action_names=(), state_names=("z",), time_step=0.01,
    )  # fmt: skip
    simulator = Drop()
    parameters = tensors(
        radius=[0.05, 0.05, 0.1], restitution=[0.9, 0.5, 0.9], plate_restitution=1.0, shift=0.25
    )
    z, vz, x = simulator.simulate(parameters, given)[:, 0].unbind(-1)
    torch.testing.assert_close(x, torch.full_like(x, 0.25))
    # Free fall at first, to the integration error g h t/2 of semi-implicit Euler.
    time = 0.01 * torch.arange(1, 21, dtype=torch.float64)
    fall = 0.4 - 0.5 * 9.81 * time**2
    torch.testing.assert_close(z[0, :20], fall, rtol=0, atol=9.81 * 0.0025 * 0.2)
    # Where it bounces the radius says, how fast it leaves the restitution.
    lowest = z.min(-1).values
    torch.testing.assert_close(lowest, parameters["radius"], rtol=0, atol=0.01)
    ratio = vz.max(-1).values / -vz.min(-1).values
    torch.testing.assert_close(ratio, parameters["restitution"], rtol=0, atol=0.06)


def test_motors_follow_positions_and_velocities(urdf):
    target = torch.full((60, 1), 0.5, dtype=torch.float64)

    def follow(mode, unit):
        command = Command(Channel("command", unit, -2.0, 0.4), f"joint hinge {mode}")
        simulator = bullet_pendulum(urdf, actions=(command,))
        given = Inputs.single(
            target, torch.zeros(2, dtype=torch.float64), action_names=("command",),
            state_names=("angle", "velocity"), time_step=TIME_STEP,
        )  # fmt: skip
        return simulator, simulator.simulate({}, given)[0]

    # Commands are limited to the channel's bounds.
    simulator, positions = follow("position", "rad")
    assert abs(float(positions[-1, 0]) - 0.4) < 1e-3
    _, velocities = follow("velocity", "rad/s")
    torch.testing.assert_close(
        velocities[:, 1], torch.full((60,), 0.4, dtype=torch.float64), rtol=0, atol=1e-6
    )
    simulator.with_effects(ViscousFriction("hinge"))
    with pytest.raises(ModelError, match="motor follows a position"):
        simulator.with_effects(CoulombFriction("hinge"))


def test_a_subclass_drives_what_no_joint_can():
    class Lifted(Drop):
        def drive(self, scene, segment, step, substep):
            height = 0.4 + 0.1 * (step + (substep + 1) / 4)
            scene.place_body(scene.bodies["ball"], {"z": height, "vz": 0.0})

    given = Inputs.single(
        torch.zeros(3, 0, dtype=torch.float64), torch.tensor([0.4], dtype=torch.float64),
        action_names=(), state_names=("z",), time_step=0.01,
    )  # fmt: skip
    z = Lifted().simulate({}, given)[0, :, 0]
    # Gravity moves it by g h² within the substep that follows.
    torch.testing.assert_close(z, torch.tensor([0.5, 0.6, 0.7]).double(), rtol=0, atol=1e-3)


def test_shorter_segments_are_padded_and_lost_simulations_are_nan(urdf, tmp_path):
    given = inputs(num_segments=2)
    mask = given.mask.clone()
    mask[1, 40:] = False
    given = type(given)(**{**vars(given), "mask": mask})
    found = bullet_pendulum(urdf).simulate(tensors(mass=[0.8, 1.0]), given)
    assert bool((found[:, 1, 40:] == 0).all())
    assert torch.equal(found[:, 1, :40], found[:, 0, :40])
    model = FaultMessenger(FaultRates(0.0, 0.0, 1.0, times=2), tmp_path)(PendulumModel(urdf))
    lost = model(given)
    assert bool(lost[..., 0, :, :].isnan().all())
    assert bool((lost[..., 1, 40:, :] == 0).all())


def test_a_sensor_may_have_its_joint_s_name(urdf):
    sensors = (
        Sensor(Channel("hinge", "rad"), "joint hinge position"),
        Sensor(Channel("velocity", "rad/s", rate_of="hinge"), "joint hinge velocity"),
    )
    simulator = bullet_pendulum(urdf, sensors=sensors)
    assert simulator.port("hinge").kind == "sensor"
    assert simulator.port("hinge_torque").kind == "force"
    given = replace(inputs(), channel_names=("hinge", "velocity"))
    pushed = simulator.with_effects(Bias("hinge_torque"))
    values = {"hinge_torque.bias.offset": torch.tensor(0.5).double()}
    usual = bullet_pendulum(urdf).with_effects(Bias("hinge"))
    same = usual.simulate({"hinge.bias.offset": values["hinge_torque.bias.offset"]}, inputs())
    assert torch.equal(pushed.simulate(values, given), same)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"parameters": {"mass": "link arm mass"}}, "no link 'arm'; it has base, pendulum|rod"),
        ({"parameters": {"mass": "rod mass"}}, "no place in a scene"),
        ({"parameters": {"mass": Parameter("weight", "N", 1.0)}}, "given as 'mass'"),
        ({"sensors": (Sensor(Channel("z", "m"), "body ball z"),)}, "no body 'ball'"),
        ({"states": ("torque",)}, "torque cannot be a state"),
        ({"sensors": (*SENSORS, Sensor(Channel("torque", "m"), "link rod x"))}, "two ports"),
    ],
)
def test_mistakes_are_one_sentence(urdf, changed, words):
    with pytest.raises(ModelError, match=words):
        bullet_pendulum(urdf, **changed)


def test_files_and_targets_that_do_not_exist_are_one_sentence(tmp_path):
    with pytest.raises(ModelError, match="does not exist"):
        BulletSimulator(tmp_path / "none.urdf", sensors=SENSORS)
    (tmp_path / "bad.urdf").write_text("<robot/>")
    with pytest.raises(ModelError, match="not a URDF file"):
        BulletSimulator(tmp_path / "bad.urdf", sensors=SENSORS)
    with pytest.raises(ModelError, match="joint <name> torque"):
        Command(Channel("u", "N m"), "joint hinge current")
    with pytest.raises(ModelError, match="substep"):
        BulletSettings(substeps=0)


def test_missing_actions_are_data_errors(urdf):
    given = Inputs.single(
        torch.zeros(5, 1), torch.zeros(2), action_names=("voltage",),
        state_names=("angle", "velocity"), time_step=TIME_STEP,
    )  # fmt: skip
    with pytest.raises(DataError, match="needs the action torque"):
        bullet_pendulum(urdf).simulate({}, given)
