"""How long the closest fit of a model takes, estimated before there is a recording."""

import time
from collections.abc import Mapping

import numpy as np
import torch

from npdr_ppl.language.model import Model
from npdr_ppl.language.only_simulator import only_simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import SEGMENT_FIT
from npdr_ppl.rollouts import Rollouts

__all__ = ["FEWEST_FITS", "MOST_FITS", "seconds_to_fit"]

RATE, SECONDS = 100.0, 5.0
"""Rate in Hz and length in s of the made-up recording. It is long enough that the simulation takes
longer than the calls."""

JITTER = 1e-3
"""Standard deviation of its positions in rad or m, as of an encoder."""

STEPS_OF_A_FIT = 60
"""Linearisations of a closest fit, each with its trials. The fits of an XL330 servo and of the six
joints of an SO-101 took 58 and 107 times as long as one, on one core."""

FEWEST_FITS, MOST_FITS = 5, 100
"""Time of a search as multiples of that of the first fit: few if nothing is found, and 100 on an
XL330 servo, where four effects were found."""

SLOW = 3.0
"""Seconds from which a second, more accurate timing is left out."""


def seconds_to_fit(model: Model, pose: Mapping[str, float], *, recorded: float) -> float | None:
    """Estimates how long the closest fit takes on this machine, within a factor of about three.

    One linearisation and its trials are timed along a made-up recording of a robot that stays in
    its pose. A fit needs more of them if its first parameters are far off, or if the simulation
    has jumps.

    Args:
        model: The Pyro model, with one simulator.
        pose: The measured positions, in rad or m, by channel.
        recorded: Length of the recording in s.

    Returns:
        The time in s; ``None`` if the simulation fails.

    Raises:
        NpdrError: No recording of these channels fits the model.
    """
    simulator = only_simulator(model)[0].simulator
    units = {sensor.name: sensor.unit for sensor in simulator.sensors}
    num = round(SECONDS * RATE)
    noise = np.random.default_rng(0).standard_normal((num + 1, len(pose)))
    rollouts = Rollouts.from_arrays(
        [np.array([*pose.values()]) + JITTER * noise],
        [np.zeros((num, len(simulator.actions)))],
        channel_names=[*pose],
        channel_units=[units[name] for name in pose],
        action_names=[action.name for action in simulator.actions],
        action_units=[action.unit for action in simulator.actions],
        time_step=1.0 / RATE,
    )
    segments = SegmentModel(model, rollouts, DataOptions())
    z, num_trials = segments.place_of({}), len(SEGMENT_FIT.near_factors) ** 2
    scale = torch.ones(len(segments.channel_names), dtype=torch.float64)
    tried = z.expand(num_trials, -1), segments.no_offsets.expand(num_trials, -1, -1)
    taken: list[float] = []
    # The first timing includes what is computed only once.
    while len(taken) < 2 and sum(taken) < SLOW:
        begin = time.perf_counter()
        now = segments.linearise(z, segments.no_offsets, scale, is_rough=True)
        segments.residuals(*tried, scale)
        taken.append(time.perf_counter() - begin)
        if not now.is_finite:
            return None
    return STEPS_OF_A_FIT * min(taken) * recorded / SECONDS
