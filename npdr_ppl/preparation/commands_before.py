"""Which commands acted before a recording began; delays and lags need them.

A servo held its first goal. A force is another matter: a robot that is released with its first
command had none before, but a log that was cut from a flight begins under thrust.
"""

from dataclasses import replace

import torch
from torch import Tensor

from npdr_ppl.engines.common.segment_start import recorded_start
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.sites import SimulatorBlackBox

__all__ = ["began_in_operation"]


def began_in_operation(box: SimulatorBlackBox, inputs: Inputs) -> bool:
    """Returns whether a recording began under its first commands, in most of its rollouts.

    So it did where the robot already moved, and where it rested, but would have moved less than
    half as far under the first commands as without any: a parameter in the middle of its prior can
    be off by half. Rollouts that begin with zero commands do not count. It is false if the
    simulator cannot tell whether the robot rested.

    Args:
        box: The model's black-box site at one point.
        inputs: The segments of the recording.
    """
    simulator = box.simulator
    columns = [
        inputs.action_names.index(action.name)
        for action in simulator.actions
        if action.name in inputs.action_names and not simulator.is_goal(action.name)
    ]
    begins = inputs.segments(((inputs.start == 0) & inputs.mask[:, 0]).nonzero()[:, 0])
    first = begins.actions[:, :1]
    counts = (first[:, 0, columns] != 0.0).any(-1)
    if not bool(counts.any()):
        return False
    begins, first = begins.segments(counts.nonzero()[:, 0]), first[counts]
    try:
        is_at_rest = recorded_start(simulator, begins, begins.start.shape).is_held
    except NpdrError:  # the simulator finds its initial states in another way
        return False
    held = first.expand_as(begins.actions)
    none = held.clone()
    none[..., columns] = 0.0
    spread = inputs.initial_readings.std(0, correction=0)
    under_first, under_none = (_drift(box, begins, actions, spread) for actions in (held, none))
    is_held = ~is_at_rest | (under_first < 0.5 * under_none)
    return float(is_held.double().mean()) > 0.5


def _drift(box: SimulatorBlackBox, inputs: Inputs, actions: Tensor, spread: Tensor) -> Tensor:
    """Returns how far the measured channels move from rest, ``(S,)``; infinite where they cannot.

    Args:
        box: The model's black-box site at one point.
        inputs: The segments.
        actions: Their commands, ``(S, K, A)``.
        spread: Spread of each channel in the recording, ``(C,)``.
    """
    rates = inputs.initial_rates
    resting = replace(
        inputs, actions=actions, initial_rates=None if rates is None else torch.zeros_like(rates)
    )
    names = [sensor.name for sensor in box.simulator.sensors]
    known = [k for k, name in enumerate(inputs.channel_names) if name in names]
    sensors = [names.index(inputs.channel_names[k]) for k in known]
    try:
        made = box.simulator.simulate(box.parameters, resting)
    except NpdrError:
        return torch.full(inputs.start.shape, torch.inf, dtype=torch.float64)
    made = made.reshape(-1, *made.shape[-3:])[0]
    moved = (made[..., sensors] - inputs.initial_values[:, None, known]) * inputs.mask[..., None]
    relative = moved / spread[known].clamp_min(1e-12)
    return relative.square().sum((-2, -1)).sqrt().double().nan_to_num(torch.inf)
