"""Plans the next recording."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.errors import DataError
from npdr_ppl.planning.causes import Known, prior_of
from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.judging import Judge, Played, information_gain
from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.search import Found, search_excitations
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts

__all__ = ["Plan", "plan_recording"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Two causes, and their separation in standard deviations of the measurements.

    Attributes:
        one: Name of a cause.
        other: Name of another one.
        before: Their separation along the recordings so far.
        after: Their separation along these and the planned one.
        random: The same with a random recording within the same limits.
    """

    one: str
    other: str
    before: float
    after: float
    random: float


@dataclass(frozen=True)
class Width:
    """A parameter's standard deviation in reference coordinates, in which the prior has 1.

    Attributes:
        name: The parameter.
        before: Standard deviation after the recordings so far.
        after: The same after the planned one.
        random: The same after a random recording within the same limits.
    """

    name: str
    before: float
    after: float
    random: float


@dataclass(frozen=True)
class Plan:
    """The next recording.

    Attributes:
        recording: Commands, and what the likeliest cause predicts that is measured.
        pairs: Separations, if there are several causes.
        widths: Widths of the parameters, if there is one cause.
        information: Expected gain of information in nats, if there is one cause.
        limits: The limits.
        found: The course of the search.
        random: A random recording within the same limits.
    """

    recording: Rollouts
    pairs: tuple[Pair, ...]
    widths: tuple[Width, ...]
    information: float
    limits: Limits
    found: Found
    random: Rollouts

    @property
    def smallest(self) -> float:
        """The smallest separation after the planned recording; NaN without pairs."""
        return min((pair.after for pair in self.pairs), default=math.nan)

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "separations": [vars(pair) for pair in self.pairs],
            "smallest_separation": self.smallest if self.pairs else None,
            "useful_separation": EXPERIMENT.useful_separation,
            "widths": [vars(width) for width in self.widths],
            "information": self.information if self.widths else None,
            "duration": self.limits.duration,
            "start": dict(
                zip(
                    self.recording.channel_names,
                    self.recording.readings[0][0].tolist(),
                    strict=True,
                )
            ),
            "num_judged": self.found.num_judged,
            "has_stopped": self.found.has_stopped,
        }


def plan_recording(
    known: Known,
    limits: Limits,
    *,
    rounds: int = 30,
    time_limit: float = math.inf,
    seed: int = 0,
    progress: Step = lambda fraction, status: None,
) -> Plan:
    """Designs the recording that tells causes apart, or that narrows one cause's parameters.

    With several causes it minimises a bound on the probability of naming the wrong one; see
    :meth:`~npdr_ppl.planning.judging.Judge.certainty`. With one, or with draws of the prior, it
    maximises the expected gain of information (Bayesian D-optimality; Chaloner & Verdinelli 1995).

    Args:
        known: The causes, from :func:`~npdr_ppl.planning.causes.causes_of_run` or
            :func:`~npdr_ppl.planning.causes.causes_of_prior`.
        limits: What the robot may do.
        rounds: Number of batches of the search.
        time_limit: Seconds after which no further batch begins. The result then depends on the
            speed of the machine.
        seed: Seed of the search.
        progress: Called with the fraction of the search that is done.

    Raises:
        DataError: No excitation keeps the limits in all causes, or a channel has no noise.
    """
    for name, channel in limits.channels.items():
        if not channel.noise > 0.0:
            raise DataError(f"{name} has no noise; write noise below [channels.{name}].")
    if not limits.actions:
        raise DataError("The model has no actions, so there are no commands to plan.")
    excitations = Excitations(limits, np.random.default_rng(seed))
    judge = Judge(known, limits, seed)
    separates = len(known.causes) > 1 and not known.is_prior

    def value_of(played: Played) -> Array:
        return judge.certainty(played) if separates else judge.gains(played)

    found = search_excitations(
        excitations, judge, value_of, rounds=rounds, time_limit=time_limit, progress=progress
    )
    if found.best is None and found.first is not None:
        raise DataError(
            "The causes cannot be simulated in short segments of any excitation; the model may "
            "need smaller integration steps."
        )
    if found.best is None or found.first is None:
        raise DataError(
            f"None of {judge.num_simulated // len(known.causes)} simulated excitations kept the "
            "limits; allow more position, speed or acceleration, or search longer."
            + (f" A simulation failed: {judge.failure}" if judge.failure else "")
        )
    both = [found.best, found.first]
    played = judge.played(
        np.stack([excitations.commands(c) for c in both]),
        np.stack([excitations.start(c) for c in both]),
    )
    planned, random = (_recording(judge, played, k) for k in range(2))
    if separates:
        pairs = _pairs(known, judge.separations(played))
        return Plan(planned, pairs, (), math.nan, limits, found, random)
    widths, information = _widths(known, judge, played)
    return Plan(planned, (), widths, information, limits, found, random)


def _pairs(known: Known, squares: Array) -> tuple[Pair, ...]:
    """Returns the separations of all pairs; of the two directions, the smaller one.

    Args:
        known: The causes.
        squares: Squared separations along the planned and the random recording, ``(2, n, n)``.
    """
    root = np.sqrt(known.separations.square().numpy() + np.maximum(squares, 0.0))
    result = []
    for a, one in enumerate(known.causes):
        for b in range(a + 1, len(known.causes)):
            before = min(float(known.separations[a, b]), float(known.separations[b, a]))
            after, random = np.minimum(root[:, a, b], root[:, b, a]).tolist()
            result.append(Pair(one.name, known.causes[b].name, before, after, random))
    return tuple(result)


def _widths(known: Known, judge: Judge, played: Played) -> tuple[tuple[Width, ...], float]:
    """Returns the widths of the parameters and the information, averaged over the causes."""
    before, after, gains = [], [], []
    for index, cause in enumerate(known.causes):
        precision = judge.precisions(played, index)
        before.append(cause.precision.inverse().diagonal().sqrt().numpy())
        after.append(precision.inverse().diagonal(dim1=-2, dim2=-1).sqrt().numpy())
        gains.append(float(information_gain(cause.precision, precision)[0]))
    prior = prior_of(known.causes[0].model)
    names = [
        site.name if width == 1 else f"{site.name}[{k}]"
        for site in prior.sites
        for width in (site.coordinates.stop - site.coordinates.start,)
        for k in range(width)
    ]
    mean_before, mean_after = np.mean(before, axis=0), np.mean(after, axis=0)
    widths = tuple(
        Width(name, *map(float, (mean_before[k], mean_after[0, k], mean_after[1, k])))
        for k, name in enumerate(names)
    )
    return widths, float(np.mean(gains))


def _recording(judge: Judge, played: Played, index: int) -> Rollouts:
    """Returns the commands of a candidate with the measurements that the first cause predicts."""
    simulator = judge.known.causes[0].simulator
    units = {c.name: c.unit for c in (*simulator.sensors, *simulator.actions)}
    return Rollouts.from_arrays(
        [np.concatenate((played.start[index][None], played.readings[0, index]))],
        [played.commands[index]],
        channel_names=judge.channels,
        action_names=judge.actions,
        time_step=judge.limits.time_step,
        channel_units=[units.get(name, "") for name in judge.channels],
        action_units=[units.get(name, "") for name in judge.actions],
    )
