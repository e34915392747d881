"""The causes that a recording leaves possible, with all that is needed to simulate them again.

``npdr plan`` reads them from ``discovery.json`` and designs the next recording.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.language.written_priors import written_prior
from npdr_ppl.rollouts.recording import Recording

__all__ = ["VERSION", "SurvivingCauses", "ranges", "surviving_causes"]

VERSION = 2
"""Version of the format; raised when a reader of the former one would misread it."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurvivingCauses:
    """Fitted hypotheses that a recording leaves possible, the likeliest first.

    Attributes:
        hypotheses: The hypotheses, fitted to the same segments.
        probabilities: Their probabilities; NaN if they were not compared.
    """

    hypotheses: tuple[Hypothesis, ...]
    probabilities: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values: the causes, and what the recording was like."""
        first = self.hypotheses[0]
        segments, rollouts = first.segments, first.segments.rollouts
        return {
            "version": VERSION,
            "causes": [
                _described(hypothesis, probability)
                for hypothesis, probability in zip(
                    self.hypotheses, self.probabilities, strict=True
                )
            ],
            "separations": self.separations().tolist(),
            "noise": dict(zip(segments.channel_names, first.fit.scale.tolist(), strict=True)),
            "independent_share": first.share,
            "segment_length": segments.inputs.num_steps,
            "time_step": rollouts.time_step,
            "seconds": max(rollouts.lengths) * rollouts.time_step,
            **ranges(rollouts),
        }

    def separations(self) -> Array:
        """Returns how far each hypothesis is from each other one along the recording, ``(n, n)``.

        Row a and column b have the distance, in standard deviations of the measurements, from
        what a simulates to what b can simulate with refitted parameters.
        """
        simulated = [h.segments.observed - h.difference for h in self.hypotheses]
        share = self.hypotheses[0].share
        result = np.zeros((len(simulated), len(simulated)))
        for b, refitted in enumerate(self.hypotheses):
            projection, scale = Projection(refitted), self.hypotheses[0].fit.scale
            for a, made in enumerate(simulated):
                if a != b:
                    change = refitted.segments.whitened(made - simulated[b], scale)
                    left = float(projection.scores(change[..., None]).information)
                    result[a, b] = math.sqrt(share * max(left, 0.0))
        return result


def surviving_causes(search: Search, doubtful: str | None) -> SurvivingCauses:
    """Returns the hypotheses that a search leaves possible.

    Args:
        search: The search.
        doubtful: Name of the effect whose alternatives are compared; ``None`` for the final model
            alone, or, if the search added no effect, for what it tried last.
    """
    added = next((a for a in search.added if a.effect.name == doubtful), None)
    if added is not None:
        found = _alternatives(search, added)
    elif search.added or not search.rounds[-1].alarm.fired:
        found = {}
    else:
        last = search.rounds[-1]
        found = {name: (last.trials[name], p) for name, p in last.weights.items() if name}
    possible = {
        name: (hypothesis, probability)
        for name, (hypothesis, probability) in found.items()
        if hypothesis.can_be_linearised
    }
    likeliest = sorted(possible, key=lambda name: possible[name][1], reverse=True)
    chosen = likeliest[: EXPERIMENT.most_causes]
    if not chosen:
        return SurvivingCauses((search.final,), (math.nan,))
    return SurvivingCauses(
        tuple(possible[name][0] for name in chosen), tuple(possible[name][1] for name in chosen)
    )


def _alternatives(search: Search, added: Added) -> Mapping[str, tuple[Hypothesis, float]]:
    """Returns an effect's alternatives that remain possible, with their probabilities, by name."""
    return {
        name: (search.trials[added.place, name], probability)
        for name, probability in added.alternatives.items()
        if (probability >= EXPERIMENT.least_probability or name in added.fitting)
        and (added.place, name) in search.trials
    }


def _described(hypothesis: Hypothesis, probability: float) -> dict[str, Any]:
    """Returns a hypothesis: effects, parameters, and how well the recording determines them."""
    information = hypothesis.share * hypothesis.linearisation.information()
    precision = information + torch.eye(len(information), dtype=torch.float64)
    return {
        "effects": [
            {
                "effect": effect.id,
                "port": effect.port,
                "constants": effect.constants,
                # Those that differ from the effect's own, which the coordinates refer to.
                "priors": {n: written_prior(p) for n, p in effect.given_priors.items()},
            }
            for effect in hypothesis.effects
        ],
        "probability": None if math.isnan(probability) else probability,
        "parameters": {name: value.tolist() for name, value in hypothesis.parameters.items()},
        "coordinates": hypothesis.fit.z.tolist(),
        "precision": precision.tolist(),
    }


def ranges(rollouts: Recording) -> dict[str, Any]:
    """Returns the ranges of the commands and of the measurements of a recording, by name."""
    is_start, step = _starts(rollouts), rollouts.time_step
    commands, readings = rollouts.usable_actions, rollouts.usable_readings
    return {
        "actions": {
            name: _range_of_commands([part[:, k] for part in commands], is_start, step)
            for k, name in enumerate(rollouts.action_names)
        },
        "channels": {
            name: _range_of_readings([part[:, k] for part in readings], is_start)
            for k, name in enumerate(rollouts.channel_names)
        },
    }


def _starts(rollouts: Recording) -> list[bool]:
    """Returns which usable stretches begin with their rollout; all, if none does.

    Behind a gap the robot is in motion, so it cannot start there.
    """
    found = [begin == 0 for spans in rollouts.spans for begin, _ in spans]
    return found if any(found) else [True] * len(found)


def _range_of_commands(
    series: Sequence[Array], is_start: Sequence[bool], time_step: float
) -> dict[str, float]:
    """Returns the least and the greatest command, its greatest rate and its bandwidth in Hz."""
    rates = np.concatenate([np.diff(part) for part in series]) / time_step
    return {
        **_range_of_readings(series, is_start),
        "max_rate": float(np.abs(rates).max(initial=0.0)),
        "bandwidth": max(_bandwidth(part, time_step) for part in series),
    }


def _range_of_readings(series: Sequence[Array], is_start: Sequence[bool]) -> dict[str, float]:
    """Returns the least and the greatest value, and those at the start of a rollout."""
    every = np.concatenate(series)
    first = [float(part[0]) for part, begins in zip(series, is_start, strict=True) if begins]
    return {
        "min": float(every.min()),
        "max": float(every.max()),
        "start_min": min(first),
        "start_max": max(first),
    }


def _bandwidth(values: Array, time_step: float) -> float:
    """Returns the frequency in Hz below which most of the power of a signal lies."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    if power.sum() == 0.0:
        return 0.0
    below = int(np.searchsorted(np.cumsum(power) / power.sum(), EXPERIMENT.power_in_band))
    return float(np.fft.rfftfreq(len(values), time_step)[below])
