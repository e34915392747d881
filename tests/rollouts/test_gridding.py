"""Measurements and commands with time stamps of their own, on a uniform grid."""

import dataclasses

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import DataError
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.clock_jumps import Jumps, without_jumps
from npdr_ppl.rollouts.gridding import recording_of
from npdr_ppl.rollouts.logs import Signal, rollouts_of
from npdr_ppl.rollouts.sampling import placed
from npdr_ppl.rollouts.tracks import Track, usual_step

STEP = 0.02


def track(time, function=np.sin):
    return Track.of(np.asarray(time), function(np.asarray(time)))


def made(channels, actions=(), **options):
    names = [(f"channel_{k}", "") for k in range(len(channels))]
    commands = [(f"action_{k}", "") for k in range(len(actions))]
    return Rollouts.of(recording_of([(channels, actions)], names, commands, **options))


def jittered(num=300, *, seed=0, size=0.005):
    noise = np.random.default_rng(seed).uniform(-size, size, num)
    return STEP * np.arange(num) + noise


def test_the_usual_step_survives_jitter_and_losses():
    time = jittered(1000)
    assert usual_step(time) == pytest.approx(STEP, rel=2e-3)
    kept = np.random.default_rng(1).random(1000) > 0.05
    assert usual_step(time[kept]) == pytest.approx(STEP, rel=1e-2)


def test_a_gap_of_no_whole_number_of_steps_does_not_change_the_usual_step():
    time = STEP * np.arange(300)
    time[100:] += 5.5 * STEP
    assert usual_step(time) == pytest.approx(STEP, rel=1e-9)
    assert made([track(time)]).time_step == STEP


def test_regular_stamps_give_a_recording_without_sampling():
    rollouts = made([track(STEP * np.arange(100))])
    assert rollouts.samplings == () and rollouts.is_whole and rollouts.lengths == (99,)
    assert np.array_equal(rollouts.readings[0][:, 0], np.sin(STEP * np.arange(100)))


def test_measurements_keep_their_own_times_and_values():
    time = jittered()
    rollouts = made([track(time)])
    (sampling,) = rollouts.samplings
    own = rollouts.time[0] + rollouts.time_step * sampling.lateness[:, 0] + time[0]
    taken = sampling.is_read[:, 0]
    assert taken.mean() > 0.9
    assert np.allclose(sampling.values[taken, 0], np.sin(own[taken]), atol=1e-12)
    # Between them, readings are interpolated.
    grid = rollouts.time[0] + time[0]
    assert np.allclose(rollouts.readings[0][:, 0], np.sin(grid), atol=1e-5)


def test_a_parabola_gives_simulations_at_the_times_of_the_measurements():
    rollouts = made([track(jittered())])
    inputs = rollouts.inputs(50)
    start = float(jittered()[0])
    ends = torch.arange(1, 51) + inputs.start[:, None]
    simulated = torch.sin(start + rollouts.time_step * ends.double())[..., None]
    simulated = torch.where(inputs.mask[..., None], simulated, 0.0)
    moved = inputs.at_measured_times(simulated, ["channel_0"])
    observed = rollouts.observation(inputs)
    assert float((moved - observed).abs().max()) < 5e-6
    assert float((simulated - observed).abs().max()) > 1e-3


def test_a_slow_channel_is_compared_where_it_was_measured():
    rollouts = made([track(STEP * np.arange(300)), track(10 * STEP * np.arange(30), np.cos)])
    (sampling,) = rollouts.samplings
    assert sampling.is_read.sum(0).tolist() == [291, 30]
    inputs = rollouts.inputs(50)
    measured = inputs.measured(["channel_0", "channel_1", "other"])
    assert measured.shape == (6, 50, 3)
    assert measured.sum((0, 1)).tolist() == [290, 29, 290]
    assert "channel_1 (10%)" in rollouts.notes[0]


def test_short_gaps_are_bridged_and_long_ones_cut():
    time = np.delete(STEP * np.arange(300), [100, 101, *range(200, 210)])
    rollouts = made([track(time)])
    assert rollouts.spans == (((0, 199), (210, 299)),)
    assert "11 of 299 steps" in rollouts.notes[0]
    inputs = rollouts.inputs(60)
    assert inputs.start.tolist() == [0, 60, 120, 180, 210, 270]
    assert inputs.mask.sum(-1).tolist() == [60, 60, 60, 19, 60, 29]


def test_commands_are_averaged_over_the_steps_they_hold_in():
    command = Track(np.array([0.0, 0.5, 0.75]), np.array([1.0, 3.0, 5.0]))
    rollouts = made([Track(np.arange(3.0), np.zeros(3))], [command])
    assert rollouts.actions[0][0].tolist() == [0.5 * 1 + 0.25 * 3 + 0.25 * 5]


def test_a_command_that_is_written_once_holds_to_the_end():
    step = Track(np.array([0.0, 1.0]), np.array([0.0, 5.0]))
    rollouts = made([track(STEP * np.arange(1501))], [step])
    assert rollouts.lengths == (1500,)
    assert rollouts.actions[0][[0, 49, 50, -1], 0].tolist() == [0.0, 0.0, 5.0, 5.0]


def test_commands_that_are_written_on_change_become_no_ramps():
    time = np.cumsum([0.0, 0.1, 0.2, 0.3, 0.7, 1.5, 3.0])
    command = Track(time, np.arange(7.0))
    rollouts = made([track(STEP * np.arange(400))], [command])
    # Ramps would have values between the whole numbers; sums over a step are rounded.
    assert set(rollouts.actions[0][:, 0].round(12).tolist()) == set(range(7))


def test_commands_that_a_log_has_lost_are_filled_by_straight_lines():
    kept = np.delete(STEP * np.arange(200), [50, 120, 121])
    rollouts = made([track(STEP * np.arange(200))], [Track(kept, kept)])
    assert np.allclose(rollouts.actions[0][[50, 120, 121], 0], STEP * np.array([50, 120, 121]))


@pytest.mark.parametrize("num_lost", [1, 2, 5])
def test_steps_in_which_a_jumping_command_was_lost_are_left_out(num_lost):
    def triangle_and_steps(time):
        return np.abs(time % 2.0 - 1.0) + 2.0 * np.sign(np.sin(np.pi * time))

    # It jumps at 1 s, at tick 50; at the lost ticks 20 and 120 it changes smoothly.
    lost = [20, *range(50, 50 + num_lost), 120]
    kept = np.delete(STEP * np.arange(200), lost)
    command = Track(kept, triangle_and_steps(kept))
    rollouts = made([track(STEP * np.arange(200))], [command])
    assert rollouts.spans[0] == ((0, 50), (50 + num_lost, 199))
    assert f"Lost commands: {num_lost} of 199 steps" in rollouts.notes[-1]


def _square(time):
    return np.where(np.arange(len(time)) % 4 < 2, 1.0, -1.0)


@pytest.mark.parametrize(
    "values",
    [
        lambda time: np.where(np.arange(len(time)) % 2, 1.0, -1.0),
        _square,
        lambda time: np.sin(3.0 * np.repeat(time[::4], 4)[: len(time)]),  # held for four rows
        lambda time: np.round(np.sin(3.0 * time), 1),  # of coarse resolution
    ],
)
def test_commands_without_rare_jumps_are_kept_where_some_were_lost(values):
    time = STEP * np.arange(400)
    is_kept = np.random.default_rng(0).random(400) > 0.05
    is_kept[[0, -1]] = True
    command = Track(time[is_kept], values(time)[is_kept])
    rollouts = made([track(time)], [command])
    assert len(rollouts.spans[0]) == 1


@pytest.mark.parametrize("seed", range(3))
def test_late_commands_are_not_taken_for_lost_ones(seed):
    # Every second step or so is longer than 1.5 usual ones, but no command is missing.
    sent = np.sort(jittered(1000, seed=seed, size=0.4 * STEP))
    sign = lambda time: np.where(np.arange(len(time)) % 7 < 3, 1.0, -1.0)  # noqa: E731
    rollouts = made([track(STEP * np.arange(1000))], [track(sent, sign)])
    (offset,) = (max(0.0, sent[0]),)
    fine = offset + STEP / 50 * (np.arange(50 * rollouts.lengths[0]) + 0.5)
    held = sign(sent)[np.searchsorted(sent, fine, side="right") - 1].reshape(-1, 50).mean(1)
    assert rollouts.actions[0][:, 0] == pytest.approx(held, abs=0.05)


def test_a_clock_of_coarse_ticks_loses_no_commands():
    sent = np.concatenate(([0.0], np.cumsum(np.tile([0.010, 0.010, 0.012], 200))))
    kept = np.delete(sent, 301)
    command = Track(kept, np.where(np.arange(len(kept)) % 2, 1.0, -1.0))
    time = sent[-1] / 600 * np.arange(601)
    values = made([track(time)], [command]).actions[0][:, 0]
    fine = time[-1] / 60_000 * (np.arange(60_000) + 0.5)
    held = command.values[np.searchsorted(kept, fine, side="right") - 1]
    wrong = np.abs(values - held.reshape(-1, 100).mean(1)) > 0.1
    # Only the command that was lost is filled; the values of all others are held.
    assert 0 < wrong.sum() <= 3 and np.ptp(np.flatnonzero(wrong)) <= 2


def test_one_odd_rollout_does_not_set_the_time_step():
    normal = [([track(STEP * np.arange(100))], [])] * 5
    odd = ([track(np.array([0.0, 0.001]))], [])
    recording = recording_of([*normal, odd], [("x", "")], [])
    assert recording.time_step == pytest.approx(STEP) and len(recording) == 5
    assert "Rollouts shorter than a step: 1" in recording.notes[0]


def test_clocks_that_run_between_each_others_rows_lose_nothing():
    rollouts = made([track(0.25 * np.arange(50)), track(0.125 + 0.25 * np.arange(50))])
    assert rollouts.samplings[0].is_read.mean() > 0.95


def test_joining_rates_keeps_what_was_left_out():
    slow = made([track(STEP * np.arange(100))])
    slow = dataclasses.replace(slow, stretches=(((0, 40), (41, 99)),))
    fast = made([track(0.5 * STEP * np.arange(100))])
    assert slow.concatenate(fast).spans == (((0, 80), (82, 198)), ((0, 99),))


def test_clocks_that_drift_apart_are_said():
    time = STEP * np.arange(1000)
    rollouts = made([track(time * (1.0 + 1e-4))], [Track(time, np.sin(time))])
    assert "differ by 0.01 %" in rollouts.notes[0]


@pytest.mark.parametrize("drift", [1e-4, -1e-4, 0.0])
def test_clocks_that_drift_apart_are_said_where_a_table_repeats_commands(drift):
    time = STEP * np.arange(1000)
    commands = np.clip(np.sin(time), -0.9, 0.9)
    stamps = time * (1.0 + drift)
    every = np.unique(np.concatenate((time, stamps)))
    held = commands[np.searchsorted(time, every, side="right") - 1]
    said = [note for note in made([track(stamps)], [Track(every, held)]).notes if "clock" in note]
    assert len(said) == (drift != 0.0)
    assert not said or "differ by 0.01 %" in said[0]


@pytest.mark.parametrize("seed", range(20))
def test_jitter_of_nearly_a_step_is_not_taken_for_a_drift(seed):
    generator = np.random.default_rng(seed)
    time = STEP * np.arange(500)
    stamps = np.sort(time + generator.uniform(-0.45, 0.45, 500) * STEP)
    assert "clock" not in " ".join(made([track(stamps)], [Track(time, np.sin(time))]).notes)


def test_clocks_of_large_numbers_are_compared_too():
    time = 1e13 + STEP * np.arange(1000)  # rounded to 2 ms
    assert made([track(time)], [Track(time, np.sin(np.arange(1000.0)))]).notes == ()


def test_commands_at_another_rate_are_not_taken_for_a_drift():
    time = STEP * np.arange(2000)
    slow = np.arange(0.0, time[-1], 20.83 * STEP)
    assert not made([track(time)], [Track(slow, np.sin(slow))]).notes


def test_a_restarted_clock_goes_on_behind_a_gap():
    time = np.concatenate((STEP * np.arange(100), 0.013 + STEP * np.arange(80)))
    (moved,), jumps = without_jumps((time,), 1)
    assert jumps == Jumps(num_restarts=1) and np.diff(moved).min() > 0
    assert np.diff(moved)[99] == pytest.approx(5 * STEP, abs=1e-9)
    late = np.concatenate((STEP * np.arange(51), [0.9], STEP * np.arange(51, 99)))
    assert without_jumps((late,), 1)[1] == Jumps(), "one message that came late"
    swapped = STEP * np.array([0, 1, 3, 2, 4])
    (kept,), jumps = without_jumps((swapped,), 1)
    assert np.array_equal(kept, swapped) and jumps == Jumps()


@pytest.mark.parametrize("wrong", [1e6, -1e6, 0.0, 1.7e9])
@pytest.mark.parametrize("row", [0, 100, 299])
@pytest.mark.parametrize("begin", [1e3, 1.6e9])
def test_a_single_wrong_stamp_costs_one_sample(wrong, row, begin):
    true = begin + STEP * np.arange(300)
    time = true.copy()
    time[row] = wrong
    (kept,), jumps = without_jumps((time,), 1)
    assert jumps == Jumps(num_outlying=1) and np.flatnonzero(np.isnan(kept)).tolist() == [row]
    assert np.array_equal(np.delete(kept, row), np.delete(true, row))


def test_a_stamp_ahead_of_those_that_follow_is_wrong_and_one_behind_a_gap_is_not():
    time = STEP * np.arange(300)
    time[100] = 3.0
    assert without_jumps((time,), 1)[1] == Jumps(num_outlying=1)
    time = np.delete(STEP * np.arange(300), slice(200, 299))
    (kept,), jumps = without_jumps((time,), 1)
    assert jumps == Jumps() and np.array_equal(kept, time)


def test_wrong_stamps_of_all_signals_leave_one_stretch():
    """A table with a command in every tenth row, in which two rows have a wrong stamp."""
    time = STEP * np.arange(500)
    time[[200, 390]] = 1e6, 0.0
    commands = time[::10].copy()
    (kept, held), jumps = without_jumps((time, commands), 1)
    assert jumps.num_restarts == 0 and np.nanmax(kept) == time[-1]
    assert np.isnan(held[20]) and np.nanmax(held) == commands[-1]


@pytest.mark.parametrize("jump", [1.7e9, 86_400.0])
def test_a_pause_or_a_clock_that_is_set_forward_becomes_a_gap(jump):
    """At 1 kHz; the command is written every 2 s, also in the pause."""
    time = 0.001 * np.arange(2000)
    time[700:] += jump
    commands = np.array([0.0, 0.5, 0.5 * jump, jump + 1.5])
    rollouts = load(time, commands)
    assert rollouts.spans == (((0, 699), (704, 2003)),)
    assert f"1, the longest of {jump:.6g} s" in rollouts.notes[0]
    values = rollouts.actions[0][:, 0]
    assert (values[0], values[650], values[710], values[1600]) == (0.0, 1.0, 2.0, 3.0)


def load(time, commands):
    signals = (
        Signal("q", time, np.sin(time)),
        Signal("u", commands, np.arange(len(commands)) * 1.0),
    )
    return Rollouts.of(rollouts_of([signals[0]], [signals[1]]))


def test_a_command_long_before_the_recording_holds():
    rollouts = load(1e4 + STEP * np.arange(300), np.array([0.0]))
    assert rollouts.notes == () and rollouts.lengths == (299,)
    rollouts = load(1e4 + STEP * np.arange(300), np.array([0.0, 1.0]))
    assert rollouts.notes == () and set(rollouts.actions[0][:, 0]) == {1.0}


@pytest.mark.parametrize("jump", ["middle", "end", "set", "day"])
def test_a_table_with_jumps_of_the_clock_is_read(tmp_path, jump):
    time = 0.001 * np.arange(1000)
    time[{"middle": slice(400, 401), "end": slice(999, 1000)}.get(jump, slice(400, 1000))] += {
        "set": 1.7e9, "day": 86_400.0
    }.get(jump, 1e6)  # fmt: skip
    rows = [f"0,{t!r},{k}" for k, t in enumerate(time.tolist())]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(["rollout,time,angle", *rows, ""]))
    rollouts = Rollouts.load(path)
    assert rollouts.num_usable >= 997 and len(rollouts.notes) >= 1


@pytest.mark.parametrize("size", [2, 3, 4])
def test_bursts_have_the_mean_step(size):
    number = np.arange(4000)
    time = 0.002 * size * (number // size) + 0.0001 * (number % size)
    assert usual_step(time) == pytest.approx(0.002, rel=2e-3)


def test_gaps_of_bursts_are_gaps_on_the_grid():
    number = np.arange(4000)
    time = 0.008 * (number // 4) + 0.0001 * (number % 4)
    restarted = np.concatenate((time, time))
    (moved,), jumps = without_jumps((restarted,), 1)
    assert jumps == Jumps(num_restarts=1)
    # Five steps of 2 ms; the step within a burst is 0.1 ms.
    assert np.diff(moved)[3999] == pytest.approx(0.01, rel=0.01)
    paused = np.where(number < 2000, time, time + 1.1)
    (kept,), jumps = without_jumps((paused,), 1)
    assert jumps == Jumps() and np.array_equal(kept, paused)


@pytest.mark.parametrize("rate, least", [(100.0, 0.99), (250.0, 0.9)])
@pytest.mark.parametrize("seed", range(5))
def test_measurements_that_share_a_row_move_to_empty_ones(rate, least, seed):
    """Jitter of ± 5 ms: the nearest rows alone hold 83 % and 71 % of the measurements."""
    noise = np.random.default_rng(seed).uniform(-0.005, 0.005, 2000)
    time = np.sort(np.arange(2000) / rate + noise)
    rollouts = made([track(time)])
    (sampling,) = rollouts.samplings
    taken = sampling.is_read[:, 0]
    assert taken.sum() >= least * 2000 and np.abs(sampling.lateness).max() <= 1.0
    own = time[0] + rollouts.time[0] + rollouts.time_step * sampling.lateness[:, 0]
    assert np.allclose(sampling.values[taken, 0], np.sin(own[taken]), rtol=0.0, atol=1e-9)
    unused = 2000 - int(taken.sum())
    said = f"{unused} of 2000 measurements of channel_0 share a time step with another"
    assert (said in " ".join(rollouts.notes)) == (unused > 0)
    assert "Not measured" not in " ".join(rollouts.notes)


def test_channels_that_lose_as_many_measurements_are_said_together():
    noise = np.random.default_rng(0).uniform(-0.005, 0.005, 2000)
    time = np.sort(np.arange(2000) / 250.0 + noise)
    uneven, regular = track(time), track(np.arange(2000) / 250.0)
    text = " ".join(made([uneven, uneven]).notes)
    assert "of 2000 measurements of every channel share a time step" in text
    text = " ".join(made([uneven, regular]).notes)
    assert "of 2000 measurements of channel_0 share a time step" in text


def test_a_gap_does_not_make_measurements_share_rows():
    noise = np.random.default_rng(0).uniform(-0.2, 0.2, 500)
    time = np.delete(STEP * (np.arange(500) + noise), slice(200, 220))
    assert made([track(time)]).samplings[0].is_read.sum() == 480


def test_measurements_move_no_further_than_a_step():
    place = np.array([0.0, 1.1, 1.2, 2.1, 4.0, 5.6, 5.8, 5.9, 7.0])
    found = placed(place, place, 9)
    assert np.flatnonzero(found.is_read).tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    at = np.arange(9) + found.lateness
    assert np.allclose(at[found.is_read], np.delete(place, 6), atol=1e-7)
    assert found.num_unused == 1


def test_a_channel_that_is_faster_than_the_steps_is_compared_at_the_rows():
    rollouts = made([track(0.001 * np.arange(1001))], time_step=0.01)
    assert rollouts.samplings == () and "900 of 1001 measurements" in rollouts.notes[0]


def test_segments_are_not_compared_with_measurements_outside_of_them():
    place = np.array([0.0, 0.6, 1.3, 2.3, 4.0, 5.0, 6.0])
    rollouts = made([track(STEP * place)], time_step=STEP)
    late = rollouts.samplings[0].lateness[:, 0]
    inputs = rollouts.inputs(3)
    assert (late[4], inputs.is_read[..., 0].tolist()) == (0.0, [[True] * 3, [True] * 3])
    early = made([track(STEP * np.array([0.0, 1.0, 2.0, 2.7, 3.2, 3.4, 6.0]))], time_step=STEP)
    assert early.samplings[0].lateness[4, 0] == pytest.approx(-0.6, abs=1e-6)
    assert early.inputs(3).is_read[..., 0].tolist() == [[True] * 3, [False, False, True]]


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npz", "nc"])
@pytest.mark.parametrize("size", [0.25, 0.5])
@pytest.mark.parametrize("is_free", [False, True], ids=["commands", "free"])
def test_every_format_keeps_times_and_gaps(tmp_path, suffix, size, is_free):
    """Jitter is given in steps; the second channel has a third of the rate."""
    time = np.delete(jittered(size=size * STEP), [50, *range(200, 210)])
    channels = [track(np.sort(time)), track(np.sort(time[::3]), np.cos)]
    rollouts = made(channels, [] if is_free else [track(STEP * np.arange(300))])
    assert read_back(rollouts, tmp_path, suffix) == rollouts


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npz", "nc"])
@pytest.mark.parametrize("seed", range(10))
def test_every_format_keeps_free_motion_at_two_rates(tmp_path, suffix, seed):
    generator = np.random.default_rng(seed)
    num = int(generator.integers(30, 200))
    slow = int(generator.integers(2, 6))
    offset = generator.uniform(0.0, STEP)
    channels = [track(STEP * np.arange(num)), track(offset + STEP * np.arange(0, num, slow))]
    rollouts = made(channels)
    again = read_back(rollouts, tmp_path, suffix)
    assert again == rollouts and again.channel_names == ("channel_0", "channel_1")


@pytest.mark.parametrize("seed", range(5))
def test_tables_keep_the_gaps_of_joined_rates(tmp_path, seed):
    parts = []
    for step in (STEP, 1.37 * STEP):
        generator = np.random.default_rng([seed, int(1e3 * step)])
        time = np.sort(step * (np.arange(300) + generator.uniform(-0.4, 0.4, 300)))
        gaps = generator.integers(10, 280, 3)
        time = np.delete(time, np.unique(np.concatenate([np.arange(g, g + 9) for g in gaps])))
        parts.append(made([track(time), track(time[::3], np.cos)], [track(time)]))
    for joined in (parts[0].concatenate(parts[1]), parts[1].concatenate(parts[0])):
        assert not joined.is_whole and read_back(joined, tmp_path, "csv") == joined


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_logs_of_two_clocks_in_one_file_have_no_drift(tmp_path, suffix):
    """Two robots whose clocks differ by 0.0035 %; commands change at each step."""
    time = STEP * np.arange(2000)
    parts = [
        made([track(scale * time)], [Track(scale * time, np.sin(time))])
        for scale in (1.0, 1.0 + 3.5e-5)
    ]
    rollouts = parts[0].concatenate(parts[1])
    again = read_back(rollouts, tmp_path, suffix)
    assert again == rollouts
    assert not [note for note in (*rollouts.notes, *again.notes) if "clock" in note]


def test_a_table_that_does_not_count_its_steps_is_refused(tmp_path):
    path = tmp_path / "data.csv"
    made([track(jittered(30))]).to_csv(path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:10], *lines[12:], ""]))
    with pytest.raises(DataError, match="step does not count the steps of rollout 0"):
        Rollouts.load(path)


def test_a_slow_channel_that_is_empty_in_the_last_row_is_no_action(tmp_path):
    rows = [f"0,{STEP * k:.2f},{np.sin(STEP * k):.6f},{'' if k % 2 else k}" for k in range(100)]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(["rollout,time,angle,temperature", *rows, ""]))
    rollouts = Rollouts.load(path)
    assert rollouts.channel_names == ("angle", "temperature") and rollouts.action_names == ()


def read_back(rollouts, folder, suffix):
    path = folder / f"data.{suffix}"
    getattr(rollouts, {"nc": "to_netcdf"}.get(suffix, f"to_{suffix}"))(path)
    return Rollouts.load(path)


def test_cells_without_a_number_are_missing_measurements(tmp_path):
    rows = [f"0,{STEP * k:.2f},{np.sin(STEP * k):.6f},{k % 3}" for k in range(100)]
    rows[30] = "0,0.60,NaN,0"
    rows[31] = "0,0.62,,1"
    path = tmp_path / "data.csv"
    path.write_text("\n".join(["rollout,time,angle,torque", *rows[:-1], "0,1.98,0.9,", ""]))
    rollouts = Rollouts.load(path)
    assert np.flatnonzero(~rollouts.samplings[0].is_read[:, 0]).tolist() == [30, 31]
    assert rollouts.action_names == ("torque",) and rollouts.is_whole


@pytest.mark.parametrize("kind", ["jitter", "loss"])
def test_parameters_of_an_unevenly_sampled_pendulum_are_found(kind):
    """Truth by another integrator: Runge-Kutta at 1 ms; 5 ms of jitter, or every tenth lost."""
    time = jittered(600)
    held = np.sort(STEP * np.arange(600) + np.random.default_rng(2).uniform(-0.005, 0.005, 600))
    torque = 2.0 * np.sin(3.1 * held) + np.sign(np.sin(5.7 * held))
    fine = np.arange(0.0, 600 * STEP, 1e-3)
    state, states = np.array([0.3, 0.0]), []

    def slope(t, x):
        value = torque[max(0, np.searchsorted(held, t, side="right") - 1)]
        return np.array([x[1], (value - 1.1 * 9.81 * 0.45 * np.sin(x[0])) / (1.1 * 0.27)])

    for t in fine:
        states.append(state)
        k1 = slope(t, state)
        k2 = slope(t + 5e-4, state + 5e-4 * k1)
        k3 = slope(t + 5e-4, state + 5e-4 * k2)
        k4 = slope(t + 1e-3 - 1e-9, state + 1e-3 * k3)
        state = state + 1e-3 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    if kind == "loss":
        time = np.delete(STEP * np.arange(600), np.arange(5, 600, 10))
    time = np.clip(time, 0.0, fine[-1])
    noise = np.random.default_rng(3).normal(0.0, 1e-3, (2, len(time)))
    channels = [
        Track.of(time, np.interp(time, fine, np.array(states)[:, k]) + 10**k * noise[k])
        for k in range(2)
    ]
    sensors = [(s.name, s.unit) for s in Pendulum.sensors]
    actions = [(a.name, a.unit) for a in Pendulum.actions]
    rollouts = Rollouts.of(recording_of([(channels, [Track.of(held, torque)])], sensors, actions))
    fitted = prepare(pendulum, rollouts, npdr.DataOptions()).hypothesis
    assert fitted is not None
    found = {name: float(value) for name, value in fitted.parameters.items()}
    assert found["mass"] == pytest.approx(1.1, rel=0.01)
    assert found["length"] == pytest.approx(0.9, rel=0.005)
    assert fitted.fit.scale.tolist() == pytest.approx([1e-3, 1e-2], rel=0.3)


def test_stamps_that_differ_by_less_than_a_nanosecond_are_one():
    time = jittered(30)
    rollouts = made([track(np.sort(np.append(time, [5e-324, 1e-310])))])
    assert rollouts.lengths == made([track(np.append(time, 0.0))]).lengths


def test_measurements_near_the_largest_float_count_as_missing():
    def glitch(time):
        values = np.sin(time)
        values[7:9] = 1.7e308, -1.7e308
        return values

    rollouts = made([track(jittered(30), glitch)])
    assert rollouts.samplings[0].is_read.sum() == 28
    assert np.abs(rollouts.readings[0]).max() < 2.0
