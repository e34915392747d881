"""The truth of the hidden rigs: the same physics as the models under test, made another way."""

import ast
from pathlib import Path

import numpy as np
import pytest
import torch
from hidden_rigs import RIGS, Hidden
from hidden_rigs.furuta_engine import record_in_mujoco
from hidden_rigs.plant import Plant
from hidden_rigs.recording import record
from hidden_rigs.sizes import drawn
from hidden_rigs.under_test import as_hidden

from npdr_ppl.models.effects import effects
from npdr_ppl.models.effects.candidates import candidate_effects
from npdr_ppl.rollouts import Rollouts

FOLDER = Path(__file__).parents[2] / "benchmarks" / "hidden_rigs"

EXCITATIONS = ("multisine", "steps", "chirp")

# What acts on one joint is tested on rigs of one joint; on the others what couples joints, and
# sensors in groups.
COUPLED = ("coulomb_friction", "tilt", "payload", "sensor_delay", "sensor_low_pass", "input_delay")

LAWS = [
    (name, *place)
    for name, rig in RIGS.items()
    for place in dict.fromkeys((*rig.effects, *rig.absorbed, *rig.inseparable))
    if len(rig.layout.joints) == 1 or place[1] in COUPLED or place[1] == "actuator_lag"
]

# Each effect once.
EFFECTS = {
    place[1]: (name, place[0])
    for name, rig in reversed(RIGS.items())
    for place in (*rig.effects, *rig.absorbed, *rig.outside)
}


def parameters_of(rig):
    return {**rig.known, **{name: sum(ends) / 2.0 for name, ends in rig.unknown.items()}}


def truth(rig, hidden=(), duration=1.5, is_from_rest=False):
    recorder = record_in_mujoco if rig.engine == "mujoco" else record
    return recorder(
        rig,
        EXCITATIONS,
        parameters=parameters_of(rig),
        hidden=hidden,
        seed=3,
        duration=duration,
        is_from_rest=is_from_rest,
    )


def simulated(rig, simulator, rollouts, hidden=()):
    """Readings of the simulator under test, and those of the truth, in its noise's units."""
    inputs = rollouts.inputs(initial_state="recorded", history=40)
    known = {parameter.name for parameter in simulator.parameters}
    values = {k: v for k, v in parameters_of(rig).items() if k in known}
    for h in hidden:
        simulator = simulator.with_effects(as_hidden(effects()[h.effect_id](h.port), h))
        values |= h.sites
    values = {k: torch.tensor(v, dtype=torch.float64) for k, v in values.items()}
    noise = torch.tensor(rig.measurement.counts + rig.measurement.velocity_noise)
    error = (simulator.simulate(values, inputs) - rollouts.observation(inputs)) / noise
    return error[inputs.mask]


def fine(rig):
    """The simulator under test with so small steps that only the laws matter."""
    simulator = rig.simulator()
    if rig.name == "two_link_arm":
        return type(simulator)(substeps=8)
    return type(simulator)(integrator="rk4", substeps=4, compile="never")


def after_silence(rollouts, num_steps=20):
    """Rollouts from rest with so many steps of rest before them: settled gears, empty delays."""
    return Rollouts.from_arrays(
        [np.pad(values, ((num_steps, 0), (0, 0))) for values in rollouts.readings],
        [np.pad(values, ((num_steps, 0), (0, 0))) for values in rollouts.actions],
        channel_names=rollouts.channel_names,
        action_names=rollouts.action_names,
        time_step=rollouts.time_step,
    )


def size(error):
    return float(error.square().mean().sqrt())


@pytest.mark.parametrize("name", RIGS)
def test_without_effects_the_truth_is_the_model_under_test(name):
    """To a hundredth of the noise over a second and a half, from other equations and steps."""
    rig = RIGS[name]
    error = simulated(rig, rig.simulator(), truth(rig).rollouts)
    assert float(error.abs().max()) < 0.01
    assert float(error.abs().max()) > 0.0  # and not by running the same code


@pytest.mark.parametrize("name", [name for name, rig in RIGS.items() if rig.engine == "equations"])
def test_the_truth_has_converged(name):
    """Half the substeps change nothing that a sensor would see."""
    rig = RIGS[name]
    coarse = record(
        rig,
        EXCITATIONS,
        parameters=parameters_of(rig),
        seed=3,
        duration=1.5,
        substeps=rig.substeps // 2,
    )
    noise = np.array(rig.measurement.counts + rig.measurement.velocity_noise)
    difference = (coarse.true_states - truth(rig).true_states) / noise
    assert np.abs(difference).max() < 0.01


# How much of an effect the package's own law may leave unexplained, where it is not next to
# nothing: MuJoCo's softer friction, velocities as differences of positions.
_TOLERANCE = {"stribeck_friction": 0.1}
_MUJOCO_TOLERANCE = 0.15


@pytest.mark.slow
@pytest.mark.parametrize(("name", "port", "effect_id"), LAWS)
def test_laws_mean_what_the_catalogue_means(name, port, effect_id):
    """With the true parameters the catalogue's effect explains the recording."""
    rig = RIGS[name]
    hidden = drawn(rig.port(port), effect_id, 1.0, np.random.default_rng(7))
    rollouts = truth(rig, (hidden,), 0.4, is_from_rest=True).rollouts
    if effect_id in ("joint_elasticity", "backlash"):
        rollouts = after_silence(rollouts)
    without = size(simulated(rig, fine(rig), rollouts))
    left = size(simulated(rig, fine(rig), rollouts, (hidden,)))
    tolerance = _TOLERANCE.get(effect_id, 0.05)
    if rig.engine == "mujoco":
        tolerance = _MUJOCO_TOLERANCE
    if (port, effect_id) == ("position", "encoder_bias"):
        assert without < 1e-3  # nothing depends on where zero is
    else:
        assert left < tolerance * without


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect_id", "strength"), [("backlash", 0.005), ("joint_elasticity", 0.05)]
)
def test_small_play_is_no_elasticity_and_a_fast_shaft_is_not_damped_by_the_integrator(
    effect_id, strength
):
    """So little of them shows on the drive; the steps are those of the model under test."""
    rig = RIGS["emps"]
    hidden = drawn(rig.port("carriage"), effect_id, strength, np.random.default_rng(7))
    rollouts = after_silence(truth(rig, (hidden,), 0.8, is_from_rest=True).rollouts)
    without = size(simulated(rig, rig.simulator(), rollouts))
    # What soft flanks, a damping integrator or a coarse law leave is half of it and more.
    assert size(simulated(rig, rig.simulator(), rollouts, (hidden,))) < 0.1 * without


@pytest.mark.parametrize("effect_id", EFFECTS)
def test_every_effect_shows(effect_id):
    """Somewhere by more than the noise's standard deviation."""
    name, port = EFFECTS[effect_id]
    rig = RIGS[name]
    strength = 10.0 if effect_id in ("clock_skew", "parameter_drift") else 2.0
    hidden = drawn(rig.port(port), effect_id, strength, np.random.default_rng(7))
    plain, changed = truth(rig).rollouts, truth(rig, (hidden,)).rollouts
    noise = np.array(rig.measurement.counts + rig.measurement.velocity_noise)
    difference = max(
        np.abs((a[: len(b)] - b[: len(a)]) / noise).max()
        for a, b in zip(plain.readings, changed.readings, strict=True)
    )
    assert difference > 1.0


@pytest.mark.parametrize("name", RIGS)
def test_effects_are_named_as_a_finder_names_them(name):
    rig = RIGS[name]
    candidates = {effect.name for effect in candidate_effects(rig.simulator())}
    alternatives = [
        place
        for table in (rig.same, rig.inseparable)
        for found in table.values()
        for alternative in found
        for place in alternative
    ]
    for port, effect_id in (*rig.effects, *rig.absorbed, *rig.inseparable, *alternatives):
        assert f"{port}.{effect_id}" in candidates
    for port, effect_id in rig.outside:
        assert effect_id not in effects()
        rig.port(port)


def test_a_joint_sticks_and_breaks_away():
    """A push below the friction moves nothing; above it only the excess counts."""
    rig = RIGS["emps"]
    gain = rig.known["drive_gain"]
    friction = Hidden("carriage", "coulomb_friction", {"magnitude": gain * 2.0})
    plant_parameters = parameters_of(rig)
    plant = Plant(
        rig.mechanics,
        rig.layout,
        plant_parameters,
        (friction,),
        num_rollouts=2,
        substep=1e-3,
        duration=1.0,
        generator=np.random.default_rng(0),
    )
    q = v = np.zeros((1, 2))
    for k in range(1000):
        q, v = plant.advance(q, v, [np.array([1.9, 3.0])], 1e-3 * k)
    assert q[0, 0] == 0.0
    rate = plant_parameters["viscous_friction"] / plant_parameters["mass"]
    speed = gain * 1.0 / plant_parameters["viscous_friction"] * (1.0 - np.exp(-rate))
    assert v[0, 1] == pytest.approx(speed, rel=1e-6)


def test_truth_makers_import_no_engine_and_no_effect():
    for path in FOLDER.glob("*.py"):
        if path.name in ("under_test.py",):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            module = getattr(node, "module", None) or ""
            assert not module.startswith(("npdr_ppl.engines", "npdr_ppl.models.effects"))
            assert not module.startswith("npdr_ppl.language.effect")
            if module.startswith("npdr_ppl.models"):
                # Constants of the arm, and the rig in the other engine.
                assert path.name in ("rigs.py", "furuta_engine.py")


@pytest.mark.parametrize("delay", [4.7e-4, 1.4e-3])
def test_a_short_delay_is_no_lag(delay):
    """It is recorded to within 5 % of its difference from a lag."""
    rig = RIGS["emps"]

    def recorded(effect_id, name, substeps=None):
        hidden = (Hidden("voltage", effect_id, {name: delay}),)
        found = record(
            rig, ("steps",), parameters=parameters_of(rig), hidden=hidden, seed=3, duration=0.4,
            substeps=substeps,
        )  # fmt: skip
        return found.rollouts.readings[0]

    late = recorded("input_delay", "delay")
    exact = recorded("input_delay", "delay", substeps=100)
    lag = recorded("actuator_lag", "time_constant", substeps=100)
    assert np.abs(late - exact).max() < 0.05 * np.abs(lag - exact).max()
