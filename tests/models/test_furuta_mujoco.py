"""The MuJoCo rig: agreement with the equations where nothing is hidden, and what is hidden."""

import math

import numpy as np
import pytest
import torch

from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import CoulombFriction, DeadZone, InputDelay, Tilt
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp

START = np.array([0.2, 1.3, -0.5, 2.0])
PERTURBED = {
    "arm_length": 0.07,
    "pole_length": 0.15,
    "pole_mass": 0.03,
    "arm_mass": 0.08,
    "motor_resistance": 7.0,
    "motor_constant": 0.05,
    "arm_damping": 1e-4,
    "pole_damping": 1e-5,
    "gravity": 9.7,
}


def wave(readings, time):
    return 5.0 * math.sin(9.0 * time)


def replay(simulator, parameters, recording):
    inputs = Inputs.single(
        torch.tensor(recording.voltage)[:, None],
        torch.tensor(recording.true_states[0]),
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=0.002,
        history=20,
    )
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in parameters.items()}
    return simulator.simulate(given, inputs)[0].numpy()


@pytest.mark.parametrize("parameters", [{}, PERTURBED], ids=["nominal", "perturbed"])
def test_rig_without_effects_follows_the_equations(parameters):
    recording = FurutaRig(parameters, encoder_counts=0).run(wave, 250, initial_state=START)
    simulated = replay(Furuta(integrator="rk4", substeps=4), parameters, recording)
    # The point mass's inertia of 1e-10 kg m² and two Runge-Kutta methods are all that differs.
    assert np.abs(simulated - recording.true_states[1:]).max() < 1e-3
    assert np.array_equal(recording.readings, recording.true_states)
    assert np.abs(recording.voltage).max() == 4.0


@pytest.mark.parametrize(
    ("rig", "effects", "strengths", "bound"),
    [
        (
            FurutaRig(arm_friction=1e-3, pole_friction=2e-4, encoder_counts=0),
            (CoulombFriction("arm"), CoulombFriction("pole")),
            {"arm.coulomb_friction.magnitude": 1e-3, "pole.coulomb_friction.magnitude": 2e-4},
            0.02,
        ),
        (
            FurutaRig(input_delay=0.007, encoder_counts=0),
            (InputDelay("voltage"),),
            {"voltage.input_delay.delay": 0.007},
            0.02,
        ),
        (
            FurutaRig(voltage_dead_zone=0.4, encoder_counts=0),
            (DeadZone("voltage"),),
            {"voltage.dead_zone.width": 0.4},
            1e-3,
        ),
        (
            FurutaRig(tilt=(0.05, -0.03), encoder_counts=0),
            (Tilt("gravity"),),
            {"gravity.tilt.roll": 0.05, "gravity.tilt.pitch": -0.03},
            1e-3,
        ),
    ],
    ids=["dry friction", "delay", "dead zone", "tilt"],
)
def test_hidden_effects_are_those_of_the_catalogue(rig, effects, strengths, bound):
    recording = rig.run(wave, 250, initial_state=START)
    base = Furuta(integrator="rk4", substeps=4)
    scale = np.abs(recording.true_states).max(0)
    without = np.abs(replay(base, {}, recording) - recording.true_states[1:]) / scale
    repaired = replay(base.with_effects(*effects), strengths, recording)
    error = np.abs(repaired - recording.true_states[1:]) / scale
    assert error.max() < bound
    assert error.max() < without.max() / 3.0


class StiffRig(FurutaRig):
    """The rig with dry friction that hardly yields."""

    def model(self):
        model = super().model()
        model.dof_solref[:] = 0.002, 1.0
        model.dof_solimp[:, :2] = 0.95, 0.99
        return model


@pytest.mark.slow
def test_dry_friction_of_the_rig_yields_and_is_the_law_where_it_does_not():
    magnitudes = {"arm": 1e-3, "pole": 1e-4}
    base = Furuta(integrator="rk4", substeps=4)
    lawful = base.with_effects(*(CoulombFriction(joint) for joint in magnitudes))
    strengths = {f"{joint}.coulomb_friction.magnitude": m for joint, m in magnitudes.items()}

    def left(kind):
        """Returns what the law leaves of the error that it is to explain, a channel."""
        rig = kind(PERTURBED, *magnitudes.values(), encoder_counts=0)
        recording = rig.run(lambda _, time: 1.5 * math.sin(9.0 * time), 250, initial_state=START)
        true = recording.true_states[1:]
        without = np.abs(replay(base, PERTURBED, recording) - true).mean(0)
        return np.abs(replay(lawful, PERTURBED | strengths, recording) - true).mean(0) / without

    # Two hundredths and eight were measured; no constraint of MuJoCo's is rigid.
    assert left(StiffRig).max() < 0.03
    # MuJoCo's constraint gives way by default, which no dry friction of the catalogue does.
    assert left(FurutaRig).min() > 0.05


def test_sensors_quantise_and_filter():
    recording = FurutaRig(velocity_time_constant=0.01).run(wave, 250, initial_state=START)
    counts = recording.readings[:, :2] / (2.0 * math.pi / 2048)
    assert np.abs(counts - np.round(counts)).max() < 1e-6
    assert np.abs(recording.readings[:, :2] - recording.true_states[:, :2]).max() < 1.6e-3
    # The filter trails the true rate by about its time constant: five steps.
    rate, true = recording.readings[:, 3], recording.true_states[:, 3]
    trails = [np.mean((rate[20:] - true[20 - lag : len(true) - lag]) ** 2) for lag in range(12)]
    assert 3 <= int(np.argmin(trails)) <= 7


def test_policy_swings_the_rig_up():
    nominal = {p.name: torch.tensor(p.nominal) for p in Furuta.parameters}
    recording = FurutaRig().run(FurutaSwingUp().controller(nominal), 2500)
    assert recording.readings.shape == (2501, 4)
    assert abs(abs(recording.true_states[-1, 1]) - math.pi) < 0.1


def test_leaving_the_bounds_ends_the_recording():
    recording = FurutaRig().run(lambda readings, time: 4.0, 2500)
    assert 50 < len(recording.voltage) < 1000
    assert len(recording.time) == len(recording.voltage) + 1


def test_unknown_parameters_are_named():
    with pytest.raises(ModelError, match="no parameter pole_colour"):
        FurutaRig({"pole_colour": 1.0})
