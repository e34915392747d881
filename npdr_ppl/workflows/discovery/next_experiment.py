"""The experiment that would tell the survivors apart.

One survivor makes a recording under each excitation, the others are refitted to it: the experiment
to do is the one whose smallest separation, over all pairs, is largest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effect_context import EquivalenceClass, Excitation
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.segment_fit import SegmentFit
from npdr_ppl.workflows.segment_model import SegmentModel

__all__ = ["NextExperiment", "next_experiment"]

SECONDS = 4.0

SAFE_SHARE = 1.0
"""Amplitude in the greatest command of the recording: never more than the device has seen."""


@dataclass(frozen=True)
class NextExperiment:
    """What to record next.

    Attributes:
        excitation: The kind of excitation; ``None`` where none that was tried helps.
        separations: Smallest separation of any two survivors, in standard deviations of the
            readings, by excitation; NaN where the simulation failed.
        amplitude: Greatest command, by action.
        separated_by: What would tell the survivors apart in words, where they are a known class.
    """

    excitation: Excitation | None
    separations: dict[str, float]
    amplitude: dict[str, float]
    separated_by: str

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        finite = {k: v if math.isfinite(v) else None for k, v in self.separations.items()}
        return {
            "excitation": self.excitation,
            "separations": finite,
            "amplitude": self.amplitude,
            "separated_by": self.separated_by,
        }


ENOUGH = 5.0
"""Separation from which an experiment is worth doing."""


def next_experiment(
    survivors: Sequence[Hypothesis],
    rollouts: Rollouts,
    options: BindingOptions,
    classes: Sequence[EquivalenceClass],
) -> NextExperiment:
    """Compares excitations by how far they would set the survivors apart.

    Args:
        survivors: Fitted hypotheses that the recording cannot tell apart.
        rollouts: The recording; its greatest commands bound the excitations.
        options: Its segments.
        classes: Equivalence classes of the effects in question.
    """
    largest = np.max([np.abs(actions).max(0) for actions in rollouts.actions], axis=0)
    separations = {}
    for name, shape in _excitations(rollouts.time_step).items():
        actions = SAFE_SHARE * largest * shape[:, None]
        try:
            separations[name] = min(
                _separation(a, b, _recorded(a, rollouts, actions), options)
                for a in survivors
                for b in survivors
                if a is not b
            )
        except NpdrError:
            separations[name] = math.nan
    finite = {name: s for name, s in separations.items() if math.isfinite(s)}
    best = max(finite, key=lambda name: finite[name]) if finite else None
    if best is not None and finite[best] < ENOUGH:
        best = None
    return NextExperiment(
        best,  # pyright: ignore[reportArgumentType]
        separations,
        dict(zip(rollouts.action_names, (SAFE_SHARE * largest).tolist(), strict=True)),
        "; ".join(dict.fromkeys(group.separated_by for group in classes)),
    )


def _excitations(time_step: float) -> dict[str, NDArray[np.float64]]:
    """Returns commands between −1 and 1, ``(T,)`` each."""
    t = np.arange(round(SECONDS / time_step)) * time_step
    levels = np.array([0.5, -0.25, 1.0, -0.75, 0.25, -1.0, 0.75, -0.5])
    phase = 2 * np.pi * (0.3 * t + 0.5 * (8.0 - 0.3) / SECONDS * t**2)
    waves = np.zeros_like(t)
    for k, frequency in enumerate((0.4, 0.9, 1.7, 3.1)):
        waves += np.sin(2 * np.pi * frequency * t + k)
    shapes = {
        "slow_ramp": 2.0 * np.abs(2.0 * (t / SECONDS - np.floor(t / SECONDS + 0.5))) - 1.0,
        "reversals": np.sign(np.sin(2 * np.pi * 1.5 * t)),
        "steps": levels[(t / SECONDS * len(levels)).astype(int)],
        "chirp": np.sin(phase),
        "hold": np.full_like(t, 0.3),
        "wide_range": waves / np.abs(waves).max(),
    }
    return {name: np.asarray(shape, dtype=np.float64) for name, shape in shapes.items()}


def _recorded(
    hypothesis: Hypothesis, rollouts: Rollouts, actions: NDArray[np.float64]
) -> Rollouts:
    """Returns what a hypothesis would record under commands ``(T, A)``, from rest."""
    segments = hypothesis.segments
    names = rollouts.channel_names
    readings = rollouts.readings[0][0]
    inputs = Inputs.single(
        torch.tensor(actions),
        torch.tensor(readings),
        action_names=rollouts.action_names,
        state_names=names,
        time_step=rollouts.time_step,
        history=segments.inputs.past_actions.shape[-2],
    )
    inputs = replace(inputs, initial_rates=torch.zeros_like(inputs.initial_values))
    box = segments.black_box(hypothesis.fit.z[None])
    simulated = box.simulator.simulate(box.parameters, inputs)[0, 0].double().numpy()
    columns = [segments.sensor_names.index(name) for name in segments.channel_names]
    start = readings[[names.index(name) for name in segments.channel_names]]
    series = np.concatenate((start[None], simulated[:, columns]))
    return Rollouts.from_arrays(
        [series],
        [actions],
        channel_names=segments.channel_names,
        action_names=rollouts.action_names,
        time_step=rollouts.time_step,
    )


def _separation(
    made: Hypothesis, refitted: Hypothesis, rollouts: Rollouts, options: BindingOptions
) -> float:
    """Returns how far a recording of one hypothesis is from the other once that is refitted."""
    segments = SegmentModel(refitted.model, rollouts, options)
    offsets: Tensor = torch.zeros(
        segments.inputs.num_segments, segments.num_offsets, dtype=torch.float64
    )
    fit = SegmentFit(refitted.fit.z, offsets, made.fit.scale)
    hypothesis = Hypothesis(refitted.model, refitted.effects, segments, fit)
    projection = Projection(hypothesis)
    score = projection.parameter_scores.sum(0)
    explained = score @ torch.linalg.solve(projection.parameter_information, score)
    return max(0.0, projection.misfit - float(explained)) ** 0.5
