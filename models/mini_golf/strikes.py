"""Strikes by the batch: draws in, trajectories out.

A stand-in for a pool of supervised workers; :func:`simulate_batch` is what is to be exchanged.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.language.inputs import Inputs

if TYPE_CHECKING:
    from npdr_ppl.models.mini_golf.simulator import MiniGolf

__all__ = ["Segment", "simulate_batch"]

Array = NDArray[np.float64]

STRIKES_PER_TASK = 16
"""A quarter of a second of work, against some milliseconds for handing it over."""


@dataclass(frozen=True)
class Segment:
    """What one simulation is told.

    Attributes:
        initial_state: State at the start, ``(states,)``.
        actions: Commands, ``(steps, actions)``.
        time_step: Seconds per step.
    """

    initial_state: Array
    actions: Array
    time_step: float


def simulate_batch(
    simulator: "MiniGolf", parameters: Mapping[str, Tensor], inputs: Inputs
) -> Tensor:
    """Simulates every parameter set along every segment, ``B + (segments, steps, sensors)``."""
    domain = simulator.nominal() | dict(parameters)
    names = tuple(domain)
    batch_shape = torch.broadcast_shapes(
        inputs.batch_shape, *(value.shape for value in domain.values())
    )
    table = torch.stack(
        [domain[name].double().cpu().expand(batch_shape).reshape(-1) for name in names], dim=-1
    )
    result = torch.zeros(
        (len(table), inputs.num_segments, inputs.num_steps, len(simulator.sensors)),
        dtype=torch.float64,
    )
    columns = [inputs.action_names.index(action.name) for action in simulator.actions]
    for rows, element in _by_element(inputs, batch_shape):
        draws = [dict(zip(names, row, strict=True)) for row in table[rows].tolist()]
        states = torch.stack(simulator.initial_states(element), dim=-1).double().cpu().numpy()
        for index in range(inputs.num_segments):
            num_steps = int(inputs.mask[index].sum())
            actions = element.actions[index, :num_steps][:, columns].double().cpu().numpy()
            segment = Segment(states[index], actions, inputs.time_step)
            values = _run_all(simulator, draws, segment)
            result[rows, index, :num_steps] = torch.from_numpy(values)
    return result.reshape(*batch_shape, *result.shape[1:]).to(inputs.actions)


def _run_all(
    simulator: "MiniGolf", draws: Sequence[Mapping[str, float]], segment: Segment
) -> Array:
    """Simulates draws along one segment, ``(n, steps, sensors)``, in processes if it pays."""
    num_workers = _num_cores()
    if num_workers == 1 or len(draws) <= STRIKES_PER_TASK:
        return _run(simulator, draws, segment)
    parts = [draws[i : i + STRIKES_PER_TASK] for i in range(0, len(draws), STRIKES_PER_TASK)]
    results = Parallel(n_jobs=min(num_workers, len(parts)))(
        delayed(_run)(simulator, part, segment) for part in parts
    )
    return np.concatenate([result for result in results if result is not None])


def _run(simulator: "MiniGolf", draws: Sequence[Mapping[str, float]], segment: Segment) -> Array:
    workspace = _workspace(type(simulator))
    return np.stack([simulator.simulate_one(workspace, draw, segment, 0) for draw in draws])


@cache
def _workspace(kind: "type[MiniGolf]") -> object:
    """Returns what strikes of one process share."""
    return kind().set_up()


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def _by_element(inputs: Inputs, batch_shape: torch.Size) -> list[tuple[Tensor, Inputs]]:
    """Returns the rows of the flat batch that share inputs, and these inputs."""
    rows = torch.arange(batch_shape.numel())
    if not inputs.batch_shape:
        return [(rows, inputs)]
    count = inputs.batch_shape.numel()
    index = torch.arange(count).reshape(inputs.batch_shape).expand(batch_shape).reshape(-1)
    return [(rows[index == i], inputs.element(i)) for i in range(count)]
