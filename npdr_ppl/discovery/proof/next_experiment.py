"""The experiment that best distinguishes the alternatives.

Each alternative simulates a recording under each excitation, and the others are refitted to it.
The best experiment is the one with the largest minimum separation over all pairs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.discovery.search.settings import EVIDENCE
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effect_context import EquivalenceClass, Excitation
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts

__all__ = ["NextExperiment", "excitation_commands", "experiment_for", "next_experiment"]


@dataclass(frozen=True)
class NextExperiment:
    """The experiment to record next.

    Attributes:
        excitation: The kind of excitation; ``None`` if no tried excitation helps.
        separations: Smallest separation of any two alternatives, in standard deviations of the
            measurements, by excitation; NaN if the simulation failed.
        amplitude: Greatest command, by action.
        separated_by: How to distinguish the alternatives, in words, if they are a known class.
        least: Least command, by action.
        differing: Parameters of the original model whose fitted values differ between the
            alternatives, with the value under each alternative, by the names of the effects that
            only it has. To measure such a parameter tells the alternatives apart.
    """

    excitation: Excitation | None
    separations: dict[str, float]
    amplitude: dict[str, float]
    separated_by: str
    least: dict[str, float] = field(default_factory=dict)
    differing: dict[str, dict[str, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        finite = {k: v if math.isfinite(v) else None for k, v in self.separations.items()}
        return {
            "excitation": self.excitation,
            "separations": finite,
            "amplitude": self.amplitude,
            "separated_by": self.separated_by,
            "least": self.least,
            "differing": self.differing,
        }


def experiment_for(
    search: Search, name: str, rollouts: Rollouts, options: DataOptions
) -> NextExperiment | None:
    """Returns the experiment that would separate the likeliest alternatives to an effect.

    Args:
        search: The search that added the effect.
        name: Name of the effect.
        rollouts: The recording.
        options: How it is cut into segments.

    Returns:
        ``None`` if the effect has no likely alternatives.
    """
    added = next(a for a in search.added if a.effect.name == name)
    likeliest = sorted(added.alternatives, key=lambda n: added.alternatives[n], reverse=True)
    names = [
        n
        for n in likeliest[: VERDICT.most_separated]
        if added.alternatives[n] >= EVIDENCE.least_probability
    ]
    alternatives = [search.trials[added.place, n] for n in names]
    if len(alternatives) < 2:
        return None
    ids = {name.rsplit(".", 1)[1] for name in names}
    classes = [g for g in added.effect.equivalence if len(ids & set(g.members)) > 1]
    return next_experiment(alternatives, rollouts, options, classes)


def next_experiment(
    alternatives: Sequence[Hypothesis],
    rollouts: Rollouts,
    options: DataOptions,
    classes: Sequence[EquivalenceClass],
) -> NextExperiment:
    """Compares excitations by the separation of the alternatives.

    Args:
        alternatives: Fitted hypotheses that the recording cannot distinguish.
        rollouts: The recording; its greatest commands bound the excitations.
        options: How it is cut into segments.
        classes: Equivalence classes of the alternatives' effects.
    """
    low, high = _ranges(alternatives[0].simulator, rollouts)
    middle, half = 0.5 * (low + high), 0.5 * EXPERIMENT.safe_share * (high - low)
    shapes = excitation_commands(rollouts.time_step)
    commands = middle + half * np.stack(list(shapes.values()))[..., None]
    made = [_made(alternative, rollouts, commands) for alternative in alternatives]
    works = np.all([np.isfinite(readings).all((1, 2)) for readings in made], axis=0)
    smallest = np.where(works, math.inf, math.nan)
    for a, readings in zip(alternatives, made, strict=True) if works.any() else ():
        recorded = _recorded(a, rollouts, readings[works], commands[works])
        simulated = _along(a, a, recorded, options)
        for b in alternatives:
            if a is not b:
                found = _separations(simulated, _along(b, a, recorded, options))
                smallest[works] = np.minimum(smallest[works], found)
    separations = dict(zip(shapes, smallest.tolist(), strict=True))
    finite = {name: s for name, s in separations.items() if math.isfinite(s)}
    best = max(finite, key=lambda name: finite[name]) if finite else None
    if best is not None and finite[best] < EXPERIMENT.useful_separation:
        best = None
    return NextExperiment(
        best,  # pyright: ignore[reportArgumentType]
        separations,
        dict(zip(rollouts.action_names, (middle + half).tolist(), strict=True)),
        "; ".join(dict.fromkeys(group.separated_by for group in classes)),
        dict(zip(rollouts.action_names, (middle - half).tolist(), strict=True)),
        _differing(alternatives),
    )


def _ranges(
    simulator: Simulator, rollouts: Rollouts
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the least and the greatest command of an excitation, ``(A,)``.

    They are as far from zero as the recording's commands, to both sides. A device that only takes
    commands of one sign, such as a rotor, gets those between the recording's least and greatest.
    """
    every = np.concatenate(rollouts.actions)
    limits = {action.name: (action.lower, action.upper) for action in simulator.actions}
    low, high = every.min(0), every.max(0)
    farthest = np.maximum(high, -low)
    lower, upper = np.array([limits[name] for name in rollouts.action_names]).reshape(-1, 2).T
    is_one_sided = (lower >= 0.0) | (upper <= 0.0)
    return np.where(is_one_sided, low, -farthest), np.where(is_one_sided, high, farthest)


def _differing(alternatives: Sequence[Hypothesis]) -> dict[str, dict[str, float]]:
    """Returns the values of the model's own parameters on which the alternatives disagree."""
    if not all(hypothesis.can_be_linearised for hypothesis in alternatives):
        return {}
    own = {name for h in alternatives for effect in h.effects for name in effect.parameter_names}
    spreads = []
    for hypothesis in alternatives:
        information = hypothesis.share * hypothesis.linearisation.information()
        eye = torch.eye(len(information), dtype=torch.float64)
        spreads.append(torch.linalg.inv(information + eye).diagonal().sqrt())
    common = set.intersection(*(set(h.names) for h in alternatives))
    causes = [" and ".join(n for n in h.names if n not in common) for h in alternatives]
    found: dict[str, dict[str, float]] = {}
    for site in alternatives[0].segments.prior.sites:
        if site.name in own or site.shape.numel() != 1:
            continue
        places = [
            next(s.coordinates for s in h.segments.prior.sites if s.name == site.name)
            for h in alternatives
        ]
        z = torch.stack([h.fit.z[p] for h, p in zip(alternatives, places, strict=True)])
        spread = torch.stack([s[p] for s, p in zip(spreads, places, strict=True)]).max()
        if float(z.max() - z.min()) > EXPERIMENT.useful_separation * float(spread):
            values = [float(h.parameters[site.name]) for h in alternatives]
            found[site.name] = dict(zip(causes, values, strict=True))
    return found


def excitation_commands(time_step: float) -> dict[str, NDArray[np.float64]]:
    """Returns commands between −1 and 1, ``(T,)`` each."""
    t = np.arange(round(EXPERIMENT.seconds / time_step)) * time_step
    levels = np.array([0.5, -0.25, 1.0, -0.75, 0.25, -1.0, 0.75, -0.5])
    phase = 2 * np.pi * (0.3 * t + 0.5 * (8.0 - 0.3) / EXPERIMENT.seconds * t**2)
    waves = np.zeros_like(t)
    for k, frequency in enumerate((0.4, 0.9, 1.7, 3.1)):
        waves += np.sin(2 * np.pi * frequency * t + k)
    shapes = {
        "slow_ramp": 2.0
        * np.abs(2.0 * (t / EXPERIMENT.seconds - np.floor(t / EXPERIMENT.seconds + 0.5)))
        - 1.0,
        "reversals": np.sign(np.sin(2 * np.pi * 1.5 * t)),
        "steps": levels[(t / EXPERIMENT.seconds * len(levels)).astype(int)],
        "chirp": np.sin(phase),
        "hold": np.full_like(t, 0.3),
        "wide_range": waves / np.abs(waves).max(),
    }
    return {name: np.asarray(shape, dtype=np.float64) for name, shape in shapes.items()}


def _made(
    hypothesis: Hypothesis, rollouts: Rollouts, commands: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Simulates measurements of a hypothesis, ``(E, T, C)``, under commands ``(E, T, A)``.

    The simulation starts at rest. Measurements are NaN if it fails.
    """
    segments = hypothesis.segments
    start = torch.tensor(rollouts.readings[0][0]).expand(len(commands), -1)
    actions = torch.tensor(commands)
    history = segments.inputs.past_actions.shape[-2]
    inputs = Inputs(
        actions=actions,
        action_names=rollouts.action_names,
        initial_readings=start,
        initial_values=start,
        channel_names=rollouts.channel_names,
        past_actions=actions.new_zeros(len(commands), history, actions.shape[-1]),
        time_step=rollouts.time_step,
        mask=torch.ones(actions.shape[:2], dtype=torch.bool),
        rollout=torch.arange(len(commands)),
        start=torch.zeros(len(commands), dtype=torch.long),
        initial_rates=torch.zeros_like(start),
        began_in_operation=segments.inputs.began_in_operation,
        is_zero=torch.ones(len(commands), 2, start.shape[-1], dtype=torch.bool),
    )
    columns = [segments.sensor_names.index(name) for name in segments.channel_names]
    box = segments.black_box(hypothesis.fit.z[None])
    try:
        simulated = box.simulator.simulate(box.parameters, inputs)[0]
    except NpdrError:
        return np.full((*commands.shape[:2], len(columns)), math.nan)
    return simulated[..., columns].double().numpy()


def _recorded(
    hypothesis: Hypothesis,
    rollouts: Rollouts,
    readings: NDArray[np.float64],
    commands: NDArray[np.float64],
) -> Rollouts:
    """Returns a recording of measurements ``(E, T, C)`` under commands ``(E, T, A)``."""
    names, channels = rollouts.channel_names, hypothesis.segments.channel_names
    start = rollouts.readings[0][0][[names.index(name) for name in channels]]
    return Rollouts.from_arrays(
        [np.concatenate((start[None], series)) for series in readings],
        list(commands),
        channel_names=channels,
        action_names=rollouts.action_names,
        time_step=rollouts.time_step,
    )


def _along(
    hypothesis: Hypothesis, made: Hypothesis, recorded: Rollouts, options: DataOptions
) -> Hypothesis:
    """Returns a hypothesis along what another one simulated, with initial states estimated there.

    Args:
        hypothesis: The hypothesis.
        made: The one that simulated the recording, whose scale of the residuals counts.
        recorded: The recording.
        options: How it is cut into segments.
    """
    segments = SegmentModel(hypothesis.model, recorded, options)
    fit = SegmentFit(hypothesis.fit.z, segments.no_offsets, made.fit.scale)
    return Hypothesis(hypothesis.model, hypothesis.effects, segments, fit)


def _separations(made: Hypothesis, refitted: Hypothesis) -> NDArray[np.float64]:
    """Returns the distance of each rollout of one hypothesis from the other, refitted to it.

    Both are simulated from the same estimated initial states, so that their errors do not count.
    The distance is NaN if one cannot be simulated there, and for rollouts of which no segment is
    used.

    Args:
        made: The hypothesis that simulated a recording, along it.
        refitted: The other one, along the same recording.
    """
    segments = refitted.segments
    num = len(segments.rollouts.readings)
    try:
        projection = Projection(refitted)
        difference = refitted.difference - made.difference
    except NpdrError:
        return np.full(num, math.nan)
    change = segments.whitened(difference, made.fit.scale)[..., None]

    def by_rollout(values: Tensor) -> Tensor:
        result = values.new_zeros(num, *values.shape[1:])
        return result.index_add(0, segments.inputs.rollout, values)

    score = by_rollout(projection.explained_by_segment(change)[..., 0])
    prior = torch.eye(score.shape[-1], dtype=torch.float64)
    information = by_rollout(projection.parameter_information_by_segment) + prior
    explained = (score * torch.linalg.solve(information, score)).sum(-1)
    left = by_rollout((change * projection.solve(change)).sum((-2, -1))) - explained
    is_used = torch.zeros(num, dtype=torch.bool)
    is_used[segments.inputs.rollout] = True
    return torch.where(is_used, left.clamp_min(0.0).sqrt(), math.nan).numpy()
