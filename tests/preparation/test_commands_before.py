"""Commands before a recording: a log can begin in operation, or with the first command."""

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_segment_model
from npdr_ppl.discovery.search.original_model import OriginalModel
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.effects import ActuatorLag
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel

GRAVITY, STEP = 9.81, 0.01


class Lift(npdr.ODESimulator):
    """A mass that a thrust lifts, or pushes along a level track."""

    states = sensors = (npdr.Channel("z", "m"), npdr.Channel("v", "m/s", rate_of="z"))
    actions = (npdr.Channel("thrust", "N", -30.0, 30.0),)
    parameters = (npdr.Parameter("mass", "kg", 1.0),)
    joints = ("z_force",)
    ports = (
        npdr.Port("z_force", "force", "N", coordinate="m"),
        npdr.Port("thrust", "action", "N"),
    )
    time_step = STEP
    weight = GRAVITY

    def accelerations(self, positions, velocities, actions, forces, constants):
        return ((actions[0] + forces[0]) / constants["mass"] - self.weight,)


class Slide(Lift):
    """The same along a level track."""

    weight = 0.0


def model_of(simulator):
    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
        return npdr.simulate("trajectory", simulator, {"mass": mass}, inputs)

    return model


def recording(first, *, weight=GRAVITY, before=0.0, speed=0.0, lag=0.03, steps=160):
    """Returns three rollouts of a unit mass behind a lag, in a hundred small steps each.

    Args:
        first: Mean thrust.
        weight: Weight of the mass.
        before: Thrust before the first command.
        speed: Speed at the start.
        lag: Time constant in s.
        steps: Number of steps.
    """
    rng = np.random.default_rng(0)
    readings, actions = [], []
    for _ in range(3):
        wave = np.cumsum(rng.normal(0.0, 1.0, steps))
        command = first + wave - wave[0]
        z, v, thrust, found = 0.0, speed, before, [0.0]
        for u in command:
            for _ in range(100):
                thrust += (u - thrust) * STEP / 100 / lag
                v += (thrust - weight) * STEP / 100
                z += v * STEP / 100
            found.append(z)
        readings.append(np.array(found)[:, None] + rng.normal(0.0, 1e-3, (steps + 1, 1)))
        actions.append(command[:, None])
    return npdr.Rollouts.from_arrays(
        readings, actions, channel_names=("z",), action_names=("thrust",), time_step=STEP
    )


def begins_in_operation(simulator, rollouts, **options):
    segments = SegmentModel(model_of(simulator), rollouts, DataOptions(**options))
    return segments.inputs.began_in_operation


def test_a_recording_began_in_operation_where_its_first_commands_kept_it_at_rest():
    hovering = recording(GRAVITY, before=GRAVITY)
    assert begins_in_operation(Lift(), hovering)
    assert not begins_in_operation(Lift(), hovering, commands_before="zero")
    assert not begins_in_operation(Lift(), recording(2.0))  # it falls with either
    assert begins_in_operation(Lift(), hovering[[0]], segment_length=None)
    pushed = recording(3.0, weight=0.0)
    assert not begins_in_operation(Slide(), pushed)
    assert begins_in_operation(Slide(), pushed, commands_before="first")
    assert begins_in_operation(Slide(), recording(3.0, weight=0.0, speed=1.0))
    assert not begins_in_operation(Slide(), recording(0.0, weight=0.0, speed=1.0))


def test_an_output_behind_a_lag_is_the_first_command_of_a_recording_in_operation():
    lagging = Lift().with_effects(ActuatorLag("thrust"))
    begun = npdr.Inputs.single(
        torch.full((40, 1), GRAVITY, dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
        action_names=("thrust",),
        state_names=("z", "v"),
        time_step=STEP,
    )
    parameters = {
        "mass": torch.tensor(1.0),
        "thrust.actuator_lag.time_constant": torch.tensor(0.05),
    }
    for inputs, speed in (
        (begun, -0.05 * GRAVITY),
        (replace(begun, began_in_operation=True), 0.0),
    ):
        made = lagging.simulate(parameters, inputs)
        assert float(made[0, -1, 1]) == pytest.approx(speed, abs=1e-3)


ROD = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.4 0 0" mass="1"/>
</body></worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-9 9"/></actuator>
</mujoco>"""


def test_a_motor_behind_a_lag_holds_a_rod_in_mujoco(tmp_path):
    (tmp_path / "rod.xml").write_text(ROD)
    rod = npdr.MujocoSimulator(tmp_path / "rod.xml", {}).with_effects(ActuatorLag("motor"))
    begun = npdr.Inputs.single(
        torch.full((40, 1), -0.2 * GRAVITY, dtype=torch.float64),
        torch.zeros(len(rod.states), dtype=torch.float64),
        action_names=("motor",),
        state_names=tuple(state.name for state in rod.states),
        time_step=STEP,
    )
    lag = {"motor.actuator_lag.time_constant": torch.tensor(0.05)}
    fallen, held = (
        float(rod.simulate(lag, replace(begun, began_in_operation=began))[0, -1].abs().max())
        for began in (False, True)
    )
    assert fallen > 0.1
    assert held < 1e-6


@pytest.mark.parametrize("before", [0.0, GRAVITY])
def test_the_likelier_commands_before_a_recording_are_taken(before):
    # Held by hand until its rotors begin, it rests as if the first thrust kept it in the air.
    rollouts = recording(GRAVITY, before=before)
    model = add_effect(model_of(Lift()), ActuatorLag("thrust"))
    said = []
    original = OriginalModel(model, rollouts, DataOptions(), report=said.append)
    assert original.base.inputs.began_in_operation
    found = original.with_likelier_commands_before(fit_segment_model(original.base))
    lag = float(found.parameters["thrust.actuator_lag.time_constant"])
    assert lag == pytest.approx(0.03, abs=3e-3)
    assert original.found_options.commands_before == ("first" if before else "zero")
    sentence = "there were no commands before the recording, so delays and lags begin from zero"
    assert said == ([] if before else [sentence])
    assert original.with_likelier_commands_before(found) is found


def lagging(low, high):
    """Returns the model with a lag, and other bounds of its mass."""

    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(low, high))
        return npdr.simulate("trajectory", Lift(), {"mass": mass}, inputs)

    return add_effect(model, ActuatorLag("thrust"))


@pytest.mark.parametrize("low", [0.5, 1.02, 1.05])
def test_a_fit_takes_the_likelier_commands_also_where_a_prior_is_too_narrow(low):
    prepared = prepare(lagging(low, 1.5), recording(GRAVITY), DataOptions())
    assert prepared.options.commands_before == "zero"
    assert not prepared.likelihood.segments.inputs.began_in_operation
    assert not prepared.widest.segments.inputs.began_in_operation
    assert prepared.alarm.p_value > 0.01
    lag = float(prepared.widest.parameters["thrust.actuator_lag.time_constant"])
    assert lag == pytest.approx(0.03, abs=3e-3)


def test_a_search_begins_with_the_likelier_commands_where_the_model_has_the_lag():
    original = OriginalModel(lagging(0.5, 1.5), recording(GRAVITY), DataOptions())
    start = original.settled(original.fit_base(may_be_rough=True))
    assert not start.segments.inputs.began_in_operation


class Hidden(Simulator):
    """It has a state that is not measured, and begins from what is."""

    states = (*Lift.states, npdr.Channel("current", "A"))
    sensors, actions, parameters = Lift.sensors, Lift.actions, Lift.parameters

    def simulate(self, parameters, inputs):
        made = torch.zeros(*inputs.actions.shape[:-1], 2, dtype=torch.float64)
        return parameters["mass"][..., None, None, None] * made


def test_a_simulator_whose_state_is_not_recorded_began_with_its_commands():
    assert not begins_in_operation(Hidden(), recording(GRAVITY, before=GRAVITY))


def test_other_words_than_the_known_ones_are_refused():
    with pytest.raises(DataError, match="'zero' or 'first', which were .*; got 'frist'"):
        DataOptions(commands_before="frist")
