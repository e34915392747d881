"""The time that a fit is expected to take, before there is a recording."""

import itertools

import pytest
import torch

from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.preparation import expected_time
from npdr_ppl.preparation.expected_time import STEPS_OF_A_FIT, seconds_to_fit


def test_it_is_that_of_the_faster_timing_and_grows_with_the_recording(monkeypatch):
    # The first timing takes 2 s, the second 1 s, for 5 s of recording.
    clock = itertools.cycle([0.0, 2.0, 2.0, 3.0])
    monkeypatch.setattr(expected_time.time, "perf_counter", lambda: next(clock))
    for recorded in (5.0, 10.0):
        found = seconds_to_fit(pendulum, {"angle": 0.1}, recorded=recorded)
        assert found == pytest.approx(STEPS_OF_A_FIT * recorded / 5.0)


def test_a_slow_robot_is_timed_once(monkeypatch):
    clock = iter([0.0, 4.0])
    monkeypatch.setattr(expected_time.time, "perf_counter", lambda: next(clock))
    assert seconds_to_fit(pendulum, {"angle": 0.1}, recorded=5.0) == 4.0 * STEPS_OF_A_FIT


def test_there_is_none_if_simulations_fail(monkeypatch):
    simulate = Pendulum.simulate

    def fails(*args, **options):
        return torch.full_like(simulate(*args, **options), torch.nan)

    monkeypatch.setattr(Pendulum, "simulate", fails)
    assert seconds_to_fit(pendulum, {"angle": 0.1}, recorded=5.0) is None
