"""The arithmetic of the benchmark of GPUs."""

import math

import gpu
import gpu_mjx
import gpu_rows
import numpy as np
import pytest
import torch


def row(size, seconds, where="cpu", case="one"):
    return gpu_rows.Row("ode", case, size, where, seconds)


def test_speed_up_compares_with_the_first_row_of_the_same_case_and_size():
    rows = [row(10, 2.0), row(20, 9.0), row(10, 0.5, "cuda"), row(10, None, "cuda, compiled")]
    assert [gpu_rows.speed_up(r, rows) for r in rows] == [1.0, 1.0, 4.0, None]


def test_a_row_without_a_measurement_is_printed_with_its_reason():
    rows = [row(10, 2.0), gpu_rows.Row("mjx", "one", 10, "MJX", note="mjx is not installed")]
    assert gpu.describe(rows[1], rows).endswith("mjx is not installed")


def test_moments_differ_by_shift_and_by_scale():
    draws = torch.tensor([[-1.0, 0.0, 1.0], [0.0, 2.0, 4.0]]).T
    assert gpu_rows.moment_difference(draws, draws) == 0.0
    shifted = draws + draws.std(0) * torch.tensor([0.0, 0.25])
    assert gpu_rows.moment_difference(draws, shifted) == pytest.approx(0.25)
    assert gpu_rows.moment_difference(draws, 1.5 * (draws - draws.mean(0))) >= 0.5


def test_largest_difference_covers_all_simulations(monkeypatch):
    monkeypatch.setattr(gpu_rows, "BLOCK", 3)
    one, other = np.zeros((7, 2)), torch.zeros(7, 2)
    other[6, 1] = -3.0
    assert gpu_rows.largest_difference(one, other) == 3.0
    other[0, 0] = math.nan
    assert math.isnan(gpu_rows.largest_difference(one, other))


def test_the_arm_replays_all_combinations_of_parameters_and_segments():
    simulator = gpu_mjx.arm("smooth", 1)
    replay = gpu_mjx.arm_replay(simulator, 128)
    assert replay.inputs.num_segments == gpu_mjx.NUM_SEGMENTS
    assert {len(v) for v in replay.flat.values()} == {128}
    together = simulator.simulate(replay.parameters, replay.inputs).flatten(0, 1)
    last = {name: value[-1] for name, value in replay.flat.items()}
    alone = simulator.simulate(last, replay.inputs.segments([gpu_mjx.NUM_SEGMENTS - 1]))
    torch.testing.assert_close(together[-1], alone[0])
    assert together.isfinite().all()
