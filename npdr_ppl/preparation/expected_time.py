"""How long the closest fit of a model takes, estimated before there is a recording."""

import time

import numpy as np
import torch

from npdr_ppl.language.model import Model
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts

__all__ = ["seconds_to_fit"]

RATE = 100.0
"""Measurements per second of the recording that is simulated for the estimate, in Hz."""

SECONDS = 5.0
"""Length of that recording in s."""

NUM_TRIALS = 9
"""Points that a fit tries after each linearisation."""

STEPS_OF_A_FIT = 60
"""Linearisations of a closest fit, each with its trials. The fits of an XL330 servo and of the six
joints of an SO-101 took as long as 58 and 107 of them."""

JITTER = 1e-3
"""Standard deviation of the positions' errors in rad or m, as of an encoder."""


def seconds_to_fit(model: Model, simulator: Simulator, *, recorded: float) -> float:
    """Estimates how long the closest fit takes on one core, within a factor of about three.

    One linearisation and its trials are timed along a robot at rest, whose positions are measured.
    More are needed the worse the start is, and the more the simulation jumps.

    Args:
        model: The Pyro model.
        simulator: Its simulator.
        recorded: Length of the recording in s.

    Returns:
        The time in s.
    """
    positions = [state for state in simulator.states if state.rate_of is None]
    reported = {sensor.name for sensor in simulator.sensors}
    channels = [state for state in positions if state.name in reported]
    num = round(SECONDS * RATE)
    shape = num + 1, len(channels)
    readings = JITTER * np.random.default_rng(0).standard_normal(shape)
    rollouts = Rollouts.from_arrays(
        [readings],
        [np.zeros((num, len(simulator.actions)))],
        channel_names=[channel.name for channel in channels],
        channel_units=[channel.unit for channel in channels],
        action_names=[action.name for action in simulator.actions],
        action_units=[action.unit for action in simulator.actions],
        time_step=1.0 / RATE,
    )
    segments = SegmentModel(model, rollouts, DataOptions())
    z = segments.place_of({})
    scale = torch.ones(len(channels), dtype=torch.float64)
    tried = z.expand(NUM_TRIALS, -1), segments.no_offsets.expand(NUM_TRIALS, -1, -1)
    taken = []
    for _ in range(2):  # the first time includes what is computed only once
        begin = time.perf_counter()
        segments.linearise(z, segments.no_offsets, scale, is_rough=True)
        segments.residuals(*tried, scale)
        taken.append(time.perf_counter() - begin)
    return STEPS_OF_A_FIT * min(taken) * recorded / SECONDS
