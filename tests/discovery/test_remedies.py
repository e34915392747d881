"""Remedies change what they say, and keep apart what was not measured."""

import dataclasses

import numpy as np
import pyro
import pyro.distributions as dist
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery import recording_repair, remedy_trials
from npdr_ppl.discovery.recording_repair import repair
from npdr_ppl.discovery.remedies import (
    Remedy,
    Shift,
    _Scaled,
    _ScaledAction,
    remedies,
)
from npdr_ppl.engines.ode.simulator import ODESimulator
from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.models.cart_pole import cart_pole
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.rollouts.notes import Remark
from tests.helpers.pendulum_recordings import swinging
from tests.helpers.rig_recordings import recording_of

STEP = 0.02


def recording(angle, velocity=None, torque=None):
    velocity = np.gradient(angle, STEP) if velocity is None else velocity
    torque = np.zeros(len(angle) - 1) if torque is None else torque
    return npdr.Rollouts.from_arrays(
        [np.stack((angle, velocity), axis=1)], [torque[:, None]],
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=STEP,
    )  # fmt: skip


SWING = np.sin(3.0 * STEP * np.arange(400))


def remedy(rollouts, words):
    (found,) = [r for r in remedies(Pendulum.sensors, rollouts) if words in r.sentence]
    return found.apply(rollouts)


@pytest.mark.parametrize("steps", [7, -7])
def test_a_shifted_channel_has_no_measurements_at_one_end(steps):
    rollouts = recording(SWING)
    moved = Shift("angle", steps)(rollouts)
    end, inner = (slice(-7, None), slice(0, -7)) if steps > 0 else (slice(0, 7), slice(7, None))
    assert not moved.samplings[0].is_read[end, 0].any()
    assert moved.samplings[0].is_read[inner, 0].all() and moved.samplings[0].is_read[:, 1].all()
    source = SWING[7:] if steps > 0 else SWING[:-7]
    assert np.array_equal(moved.readings[0][inner, 0], source)
    assert moved.spans == (((0, 392),),) if steps > 0 else moved.spans == (((7, 399),),)


@pytest.mark.parametrize("steps", [7, -7])
def test_where_shifted_commands_are_not_known_the_recording_is_not_usable(steps):
    torque = np.arange(399.0)
    moved = Shift(None, steps)(recording(SWING, torque=torque))
    ((span,),) = moved.spans
    assert span == ((0, 392) if steps > 0 else (7, 399))
    inner = moved.actions[0][slice(*span), 0]
    assert np.array_equal(inner, torque[slice(*span)] + steps)


@pytest.mark.parametrize("steps", [2.3, -2.3])
def test_shifts_need_not_be_whole_steps(steps):
    wave = recording(SWING, torque=np.arange(399.0))
    moved = Shift("angle", steps)(wave)
    time = STEP * (np.arange(400) + moved.samplings[0].lateness[:, 0] + steps)
    inner = slice(5, -5)
    assert moved.samplings[0].is_read[inner, 0].all()
    assert moved.samplings[0].values[inner, 0] == pytest.approx(np.sin(3.0 * time)[inner])
    shifted = Shift(None, steps)(wave)
    (((first, end),),) = shifted.spans
    assert (first, end) == ((0, 396) if steps > 0 else (3, 399))
    expected = np.arange(399.0)[first:end] + steps
    assert shifted.actions[0][first:end, 0] == pytest.approx(expected)


def test_limits_are_left_out_and_what_was_left_out_before_stays_so():
    rollouts = recording(np.clip(SWING, -0.8, 0.8), 3.0 * np.cos(3.0 * STEP * np.arange(400)))
    rollouts = dataclasses.replace(rollouts, stretches=(((0, 20), (21, 399)),))
    found = remedy(rollouts, "angle looks clipped")
    is_read = found.samplings[0].is_read[:, 0]
    assert np.array_equal(~is_read, np.abs(rollouts.readings[0][:, 0]) == 0.8)
    assert not any(first <= 20 < end for first, end in found.spans[0])
    assert np.abs(found.readings[0][~is_read, 0]).max() < 0.8


def test_commands_that_never_change_are_neither_shifted_nor_turned_round():
    sentences = " ".join(r.sentence for r in remedies(Pendulum.sensors, recording(SWING)))
    assert "commands" not in sentences and "torque" not in sentences
    moving = recording(SWING, torque=SWING[1:])
    sentences = " ".join(r.sentence for r in remedies(Pendulum.sensors, moving))
    assert "commands" in sentences and "sign of torque" in sentences


@pytest.mark.parametrize("name", ["angle", "velocity"])
def test_signs_are_restored_from_the_other_channel(name):
    true = recording(SWING, 3.0 * np.cos(3.0 * STEP * np.arange(400)))
    column = true.channel_names.index(name)
    values = [readings.copy() for readings in true.readings]
    values[0][:, column] = np.abs(values[0][:, column])
    found = remedy(dataclasses.replace(true, readings=tuple(values)), f"{name} looks recorded wi")
    same = np.sign(found.readings[0][:, column]) == np.sign(true.readings[0][:, column])
    # 8 s at 3 rad/s have eight zero crossings; the sample beside each may fall on either side.
    assert (~same).sum() <= 8


def test_strict_refuses_faults_and_nothing_else():
    rng = np.random.default_rng(0)
    angle = SWING + rng.normal(0.0, 1e-4, 400)
    velocity = 3.0 * np.cos(3.0 * STEP * np.arange(400)) + rng.normal(0.0, 1e-3, 400)
    # The torque that makes a rod of 1 kg and 1 m swing like this.
    torque = -9.0 / 3.0 * SWING[:-1] + 0.5 * 9.81 * np.sin(SWING[:-1])
    remarks = (Remark("Rates differ."),)
    sound = dataclasses.replace(recording(angle, velocity, torque), notes=remarks)
    strict = npdr.DataOptions(strict=True)
    assert repair(pendulum, sound, strict).rollouts.notes == remarks
    velocity[200] += 3.0
    spoilt = recording(angle, velocity, torque)
    with pytest.raises(DataError, match="one measurement of velocity left out"):
        repair(pendulum, spoilt, strict)
    assert len(repair(pendulum, spoilt, npdr.DataOptions()).rollouts.notes) == 1


@pytest.mark.slow
def test_a_fault_in_one_of_four_channels_is_not_hidden_by_the_others():
    rollouts = recording_of("cart_pole").rollouts
    names = rollouts.channel_names
    inverted = np.where(np.array(names) == "cart_velocity", -1.0, 1.0)
    spoilt = dataclasses.replace(rollouts, readings=tuple(r * inverted for r in rollouts.readings))
    found = repair(cart_pole, spoilt, npdr.DataOptions())
    assert [r.sentence for r in found.remedies] == [
        "The sign of cart_velocity looks inverted; changed."
    ]
    assert np.allclose(found.rollouts.readings[0], rollouts.readings[0])
    assert repair(cart_pole, rollouts, npdr.DataOptions()).remedies == ()


@pytest.mark.parametrize("step", [0.02, 0.002])
def test_early_stamps_are_tried_only_beyond_the_delays_of_devices(step):
    torque = np.sin(np.arange(400))[:-1]
    rollouts = npdr.Rollouts.from_arrays(
        [np.stack((SWING, SWING), axis=1)], [torque[:, None]],
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=step,
    )  # fmt: skip
    shifts = [r.apply.steps for r in remedies(Pendulum.sensors, rollouts)
              if isinstance(r.apply, Shift) and r.apply.channel is None]  # fmt: skip
    early = [-steps * step for steps in shifts if steps < 0]
    assert early and min(early) > 0.04
    assert max(early) >= 0.089


@pytest.mark.slow
def test_commands_beyond_the_range_of_a_model_are_said():
    rollouts = swinging(steps=240)
    plain = repair(pendulum, rollouts, npdr.DataOptions()).rollouts
    assert not any("range" in note for note in plain.notes)
    strong = dataclasses.replace(rollouts, actions=tuple(10.0 * a for a in rollouts.actions))
    share = np.mean(np.abs(np.concatenate(strong.actions)) > 4.5)
    (note,) = [
        n for n in repair(pendulum, strong, npdr.DataOptions()).rollouts.notes if "range" in n
    ]
    assert note == (
        f"{100.0 * share:.3g} % of the commands torque are beyond the model's range, -4.5 to "
        "4.5 N m; simulations limit them to it."
    )
    assert isinstance(note, Remark)


def test_the_fit_of_a_shift_begins_at_that_of_the_nearest_shift(monkeypatch):
    begun = {}

    fit = remedy_trials.Windows.fitted

    def fitted(self, model, rollouts, start=None):
        found = fit(self, model, rollouts, start)
        begun[id(found)] = start
        kept.append(found)
        return found

    kept = []
    settings = dataclasses.replace(recording_repair.REPAIR, first_segments=100)
    monkeypatch.setattr(remedy_trials, "REPAIR", settings)
    monkeypatch.setattr(remedy_trials.Windows, "fitted", fitted)
    rollouts = swinging(steps=240)
    windows = remedy_trials.Windows(rollouts, npdr.DataOptions(None, 30))
    as_read = windows.fitted(pendulum, rollouts)
    trials = remedy_trials.RemedyTrials(pendulum, rollouts, windows, as_read)
    for remedy in (Shift(None, 2).remedy, Shift(None, 4).remedy, Shift(None, 1).remedy):
        trials.ratio(remedy)
    inverted = next(r for r in remedies(Pendulum.sensors, rollouts) if "sign" in r.sentence)
    trials.ratio(inverted)
    _, two, four, one, sign = kept
    assert begun[id(two)] == as_read.parameters
    assert begun[id(four)] == two.parameters
    assert begun[id(one)] in (as_read.parameters, two.parameters)
    assert begun[id(sign)] is None


def test_remedies_of_the_whole_recording_are_fewer():
    every = {r.sentence for r in remedies(Pendulum.sensors, recording(SWING))}
    whole = {r.sentence for r in remedies(Pendulum.sensors, recording(SWING), singly=False)}
    assert whole < every
    assert all(
        "time stamps of the commands" in s or "torque" in s or "angle and velocity look" in s
        for s in whole
    )


def test_a_fit_begins_where_the_check_has_searched(monkeypatch):
    """A search of the priors takes minutes on a whole arm, and one is enough."""
    begun = []

    def fitted(segments, *, near, **options):
        begun.append(near)
        raise DataError("enough")

    monkeypatch.setattr("npdr_ppl.discovery.search.original_model.fit_base", fitted)
    rollouts, options = swinging(steps=90), npdr.DataOptions(None, 30)
    for large in (0.0, 1.0):  # the rough fit leaves much, or little
        settings = dataclasses.replace(recording_repair.REPAIR, large_residual=large)
        monkeypatch.setattr(recording_repair, "REPAIR", settings)
        monkeypatch.setattr(recording_repair, "_trusted_remedy", lambda *_: None)
        for prepared in (prepare, npdr.discover):
            with pytest.raises(DataError, match="enough"):
                prepared(pendulum, rollouts, options=options)
    searched, again, *others = begun
    assert searched.keys() == again.keys() == {"mass", "length"}
    assert others == [None, None]


@pytest.mark.slow
def test_no_remedy_is_needed_where_its_parameters_explain_the_recording_as_it_is(monkeypatch):
    """A fit that got stuck is no fault of the data."""
    rollouts, options = swinging(steps=240), npdr.DataOptions(None, 30)
    fit = remedy_trials.Windows.fitted

    def stuck(self, model, recording, start=None):
        found = fit(self, model, recording, start)
        if recording is rollouts and start is None:
            away = dataclasses.replace(found.fit, z=found.fit.z + 2.0)
            return dataclasses.replace(found, fit=away)
        return found

    monkeypatch.setattr(remedy_trials.Windows, "fitted", stuck)
    monkeypatch.setattr(recording_repair, "_searched", lambda *_: None)
    windows = remedy_trials.Windows(rollouts, options)
    as_read = windows.fitted(pendulum, rollouts)
    trials = remedy_trials.RemedyTrials(pendulum, rollouts, windows, as_read)
    shift = Shift(None, 1).remedy
    assert trials.ratio(shift) < recording_repair.REPAIR.remedy_factor
    assert trials.ratio_without(shift) < trials.ratio(shift)
    assert recording_repair._remedy_for(pendulum, rollouts, options, print) == (None, None)


class Wheel(ODESimulator):
    """A wheel with viscous friction, whose motion is linear: its inertia can hide a wrong unit."""

    states = (Channel("angle", "rad"), Channel("velocity", "rad/s", rate_of="angle"))
    sensors = states
    actions = (Channel("torque", "N m"),)
    parameters = (Parameter("inertia", "kg m²", 1.0), Parameter("damping", "N m s/rad", 0.5))
    joints = ("axle",)
    ports = (Port("axle", "force", "N m", rated=1.0),)
    time_step = STEP

    def accelerations(self, positions, velocities, actions, forces, constants):
        moment = actions[0] - constants["damping"] * velocities[0] + forces[0]
        return (moment / constants["inertia"],)


def wheel(inputs):
    names = "inertia", "damping"
    values = {name: pyro.sample(name, dist.LogNormal(-0.3, 0.4)) for name in names}
    return npdr.simulate("x", Wheel(), values, inputs)


def turned(inertia, unit):
    """A wheel that a torque turns to and fro, by exact steps; readings in a unit."""
    states, decay = [np.zeros(2)], np.exp(-0.5 * STEP / inertia)
    torque = 2.0 * np.sin(3.0 * STEP * np.arange(600)) + np.sign(np.sin(STEP * np.arange(600)))
    for value in torque:
        (angle, velocity), final = states[-1], value / 0.5
        moved = final * STEP + (velocity - final) * (1.0 - decay) * inertia / 0.5
        states.append(np.array([angle + moved, final + (velocity - final) * decay]))
    noise = np.random.default_rng(0).normal(0.0, (1e-3, 1e-2), (601, 2))
    angle, velocity = ((np.array(states) + noise) / unit).T
    return recording(angle, velocity, torque)


@pytest.mark.slow
def test_a_wrong_unit_is_found_although_other_parameters_could_explain_it():
    repaired = repair(wheel, turned(1.0, np.pi / 180.0), npdr.DataOptions())
    assert any("angle and velocity look recorded in degrees" in n for n in repaired.rollouts.notes)


@pytest.mark.slow
def test_parameters_beyond_their_priors_are_no_fault():
    assert not repair(wheel, turned(8.0, 1.0), npdr.DataOptions()).remedies


@pytest.mark.parametrize(("wider", "is_applied"), [(1.0, True), (0.5, False)])
def test_a_remedy_that_leaves_much_must_beat_wider_priors(monkeypatch, wider, is_applied):
    def ratio(trials, remedy):
        return 0.4 if remedy.sentence.startswith("The sign of torque") else 1.0

    trials = remedy_trials.RemedyTrials
    monkeypatch.setattr(trials, "ratio", ratio)
    monkeypatch.setattr(trials, "ratio_without", lambda trials, remedy: 1.0)
    monkeypatch.setattr(trials, "ratio_with_wider_priors", lambda trials, as_read: wider)
    options = npdr.DataOptions(None, 20)
    found, _ = recording_repair._remedy_for(wheel, turned(20.0, 1.0), options, print)
    assert (found is not None) == is_applied


def test_of_a_long_recording_remedies_are_tried_along_the_same_segments(monkeypatch):
    settings = dataclasses.replace(recording_repair.REPAIR, most_segments=5)
    monkeypatch.setattr(remedy_trials, "REPAIR", settings)
    rollouts = turned(1.0, 1.0)
    windows = remedy_trials.Windows(rollouts, npdr.DataOptions(None, 20))
    whole = windows.fitted(wheel, rollouts).segments.inputs
    moved = windows.fitted(wheel, Shift(None, -3)(rollouts)).segments.inputs
    assert len(whole.start) == 5 and whole.start.max() > 300
    assert (moved.start - whole.start).abs().max() <= 10


def test_only_hopeful_remedies_are_tried_along_all_segments(monkeypatch):
    settings = dataclasses.replace(recording_repair.REPAIR, most_segments=16, first_segments=4)
    monkeypatch.setattr(remedy_trials, "REPAIR", settings)
    rollouts = _ScaledAction("torque", -1.0)(turned(1.0, 1.0))
    windows = remedy_trials.Windows(rollouts, npdr.DataOptions(None, 20))
    trials = remedy_trials.RemedyTrials(wheel, rollouts, windows, windows.fitted(wheel, rollouts))
    fit, sizes = remedy_trials.Windows.fitted, []

    def counted(self, model, recording, start=None):
        found = fit(self, model, recording, start)
        sizes.append(found.segments.inputs.num_segments)
        return found

    monkeypatch.setattr(remedy_trials.Windows, "fitted", counted)
    assert trials.ratio(Remedy("", _Scaled(["angle"], 57.3))) > settings.hopeless_ratio
    assert sizes == [4]
    assert trials.ratio(Remedy("", _ScaledAction("torque", -1.0))) < settings.remedy_factor
    assert sizes == [4, 4, 16]


def _swapped(time):
    time[[200, 201]] = time[[201, 200]]


def _restarted(time):
    time[200:] -= time[200]


def _with_gap(time):
    time[200:] += 10.0 * STEP


def _repeated(time):
    time[200] = time[199]


def _with_jitter(time):
    time[1:-1] += np.random.default_rng(0).uniform(-0.3 * STEP, 0.3 * STEP, len(time) - 2)


def swing_read_at(path, change):
    """Writes a swing as a log whose time stamps were changed, and reads it."""
    time = STEP * np.arange(400)
    columns = {"t": time, "angle": SWING, "velocity": 3.0 * np.cos(3.0 * time), "torque": -SWING}
    columns["t"] = time.copy()
    change(columns["t"])
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    (path / "log.csv").write_text("\n".join(lines))
    entries = {name: {"signal": name} for name in ("angle", "velocity")}
    mapping = {"channels": entries, "actions": {"torque": {"signal": "torque"}}}
    return npdr.Rollouts.load(path / "log.csv", mapping)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_restarted, "The clock was restarted once"),
        (_with_gap, "Gaps: "),
        (_repeated, "Repeated time stamps: 1"),
        (_swapped, "Samples out of order: 1"),
    ],
)
def test_strict_refuses_faults_of_the_time_that_were_found_on_reading(change, sentence, tmp_path):
    read = swing_read_at(tmp_path, change)
    assert any(note.startswith(sentence) for note in read.notes)
    with pytest.raises(DataError, match=f"^{sentence}"):
        repair(pendulum, read, npdr.DataOptions(strict=True, initial_state="estimated"))


def test_strict_refuses_faults_of_the_time_for_a_model_of_two_simulators_too(tmp_path):
    def two_arms(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        for name in ("left", "right"):
            npdr.simulate(name, Pendulum(), {"mass": mass, "length": mass}, inputs)

    read = swing_read_at(tmp_path, _with_gap)
    assert repair(two_arms, read, npdr.DataOptions()).rollouts is read
    with pytest.raises(DataError, match="^Gaps: "):
        repair(two_arms, read, npdr.DataOptions(strict=True))


@pytest.mark.parametrize("change", [lambda time: None, _with_jitter])
def test_strict_does_not_refuse_how_a_log_was_read(change, tmp_path):
    read = swing_read_at(tmp_path, change)
    assert "time is 't', taken as s." in read.notes
    options = npdr.DataOptions(strict=True, initial_state="estimated")
    assert repair(pendulum, read, options).rollouts.notes == read.notes


def test_a_refusal_after_a_fault_keeps_the_columns_names():
    frozen = recording(np.full(400, 0.3), np.gradient(SWING, STEP))
    with pytest.raises(
        DataError, match=r"angle never changes.* not used; the column angle is mis"
    ):
        repair(pendulum, frozen, npdr.DataOptions())


@pytest.mark.parametrize(("lag", "is_applied"), [(0.2, False), (0.4, False), (0.8, True)])
def test_early_stamps_must_explain_twice_as_well_as_a_lag_of_the_device(
    monkeypatch, lag, is_applied
):
    early = Shift(None, -3.0).remedy

    class Tried:
        present = {"angle": 1.0}

        def ratio(self, remedy):
            return 0.3 if remedy.sentence == early.sentence else 1.0

        def ratio_without(self, remedy):
            return 1.0

        def ratio_with_lag(self):
            return lag

    monkeypatch.setattr(recording_repair, "RemedyTrials", lambda *_: Tried())
    monkeypatch.setattr(recording_repair, "remedies", lambda *_, **__: [early])
    rollouts = swinging()
    found = recording_repair._trusted_remedy(
        pendulum, rollouts, npdr.DataOptions(segment_length=20), None, None, lambda _: None
    )
    assert (found is not None) is is_applied


def test_every_channel_moves_in_some_of_the_first_segments():
    recorded = turned(1.0, 1.0)
    length = 20
    for moving in range(0, 30, 7):
        readings = [array.copy() for array in recorded.readings]
        own = slice(moving * length, (moving + 1) * length)
        readings[0][:, 1] = 0.0
        readings[0][own, 1] = np.linspace(0.0, 5.0, length)
        changed = dataclasses.replace(recorded, readings=tuple(readings))
        windows = remedy_trials.Windows(changed, npdr.DataOptions(None, length))
        assert (0, moving * length) in windows.few._places
