"""Plans the next recording."""

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.errors import DataError
from npdr_ppl.planning.causes import Known, at_time_step, prior_of
from npdr_ppl.planning.chances import Chance
from npdr_ppl.planning.exploration import Explored, explore, separates
from npdr_ppl.planning.fine_steps import in_fine_steps
from npdr_ppl.planning.judging import Judge, Played
from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.search import Found
from npdr_ppl.planning.selection import chance_of, rollouts_that_inform, rollouts_that_separate
from npdr_ppl.planning.separations import Shown, information_gain
from npdr_ppl.planning.settings import PLANNING
from npdr_ppl.planning.wider import Wider, chances_with_wider_limits
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
        random: The same with as many random rollouts within the same limits.
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
class Outlook:
    """What a search with all recordings is expected to say, if there are several causes.

    Attributes:
        planned: The chance that it names the right cause, and a wrong one, after the plan.
        random: The same after as many random rollouts.
        needed: Smallest number of such rollouts after which the chance is at least 0.95; ``None``
            if more than 60 would be needed.
        wider: The chance with each limit up to twice as wide, if that of the plan is less than
            0.95.
    """

    planned: Chance
    random: Chance
    needed: int | None
    wider: tuple[Wider, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "chance_of_the_right_name": self.planned.right,
            "chance_of_a_wrong_name": self.planned.wrong,
            "random_chance_of_the_right_name": self.random.right,
            "wanted_chance": PLANNING.wanted,
            "needed_rollouts": self.needed,
            "most_needed_rollouts": PLANNING.most_needed,
            "with_twice_the": {wider.limit: wider.chance for wider in self.wider},
        }


@dataclass(frozen=True)
class Plan:
    """The next recording.

    Attributes:
        recording: Commands, and what the likeliest cause predicts that is measured.
        pairs: Separations, if there are several causes.
        outlook: What a search is expected to say, if there are several causes.
        widths: Widths of the parameters, if there is one cause.
        information: Expected gain of information in nats, if there is one cause.
        limits: The limits.
        found: The course of the search.
        random: As many random rollouts within the same limits.
    """

    recording: Rollouts
    pairs: tuple[Pair, ...]
    outlook: Outlook | None
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
        names = self.recording.channel_names
        return {
            "separations": [vars(pair) for pair in self.pairs],
            "smallest_separation": self.smallest if self.pairs else None,
            "useful_separation": EXPERIMENT.useful_separation,
            "outlook": self.outlook.to_dict() if self.outlook else None,
            "widths": [vars(width) for width in self.widths],
            "information": self.information if self.widths else None,
            "rollouts": len(self.recording),
            "duration": self.limits.duration,
            "starts": [
                dict(zip(names, readings[0].tolist(), strict=True))
                for readings in self.recording.readings
            ],
            "num_judged": self.found.num_judged,
            "has_stopped": self.found.has_stopped,
        }


def plan_recording(
    known: Known,
    limits: Limits,
    *,
    rollouts: int | None = None,
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
        rollouts: Number of rollouts. ``None`` plans one, or with several causes as many as are
            expected to be needed, in total at most two minutes.
        rounds: Number of batches of the search.
        time_limit: Seconds after which no further batch begins. The result then depends on the
            speed of the machine.
        seed: Seed of the search.
        progress: Called with the fraction of the search that is done.

    Raises:
        DataError: No excitation keeps the limits in all causes, or a channel has no noise.
    """
    _check(limits, rollouts)
    begin, known = time.monotonic(), at_time_step(known, limits.time_step)
    is_separating = separates(known)
    if is_separating:
        progress(None, "compare with finer integration steps")
        known = in_fine_steps(known, limits, seed)
    time_limit = max(0.0, time_limit - (time.monotonic() - begin))
    begin = time.monotonic()
    explored = explore(
        known,
        limits,
        num_candidates=None if is_separating or rollouts else 1,
        rounds=rounds,
        time_limit=time_limit * (PLANNING.search_share if is_separating else 1.0),
        seed=seed,
        progress=progress,
    )
    progress(None, "compute what the best excitations show")
    if not is_separating:
        return _informing(known, explored, rollouts or 1)
    searched = time.monotonic()
    most = rollouts or _most_rollouts(explored)
    plan = _separating(known, explored, rollouts, most)
    outlook = plan.outlook
    if outlook is None or outlook.planned.right >= PLANNING.wanted:
        return plan
    figured = time.monotonic()
    progress(None, "try wider limits")
    wider = chances_with_wider_limits(
        known,
        limits,
        most,
        seed=seed,
        time_limit=time_limit - (figured - begin),
        least_time=figured - searched,
    )
    return replace(plan, outlook=replace(outlook, wider=wider))


def _check(limits: Limits, rollouts: int | None) -> None:
    """Raises a DataError if there is nothing to plan, or nothing to judge it by."""
    for name, channel in limits.channels.items():
        if not channel.noise > 0.0:
            raise DataError(f"{name} has no noise; write noise below [channels.{name}].")
    if not limits.actions:
        raise DataError("The model has no actions, so there are no commands to plan.")
    if rollouts is not None and not 1 <= rollouts <= PLANNING.most_needed:
        raise DataError(
            f"A plan has between 1 and {PLANNING.most_needed} rollouts, not {rollouts}."
        )


def _most_rollouts(explored: Explored) -> int:
    """Returns how many rollouts a plan may have that the user asked no number of."""
    in_time = int(PLANNING.most_recorded / explored.judge.limits.duration + 1e-9)
    return max(1, min(PLANNING.most_needed, in_time, len(explored.every)))


def _separating(known: Known, explored: Explored, rollouts: int | None, most: int) -> Plan:
    """Returns the plan that tells several causes apart.

    Args:
        known: The causes.
        explored: The candidates.
        rollouts: Number of rollouts; ``None`` for as many as are needed.
        most: Greatest number of rollouts.
    """
    shown = explored.judge.shown(explored.played)
    every = rollouts_that_separate(
        known,
        shown,
        explored.every,
        least=rollouts or 1,
        most=max(most, PLANNING.most_needed),
        num_distinct=most,
    )

    def fewest(wanted: float, candidates: Sequence[int]) -> int | None:
        """Returns how many of the first candidates suffice; ``None`` if not even all do."""

        def suffice(number: int) -> bool:
            return chance_of(known, shown, candidates[:number]).right >= wanted

        if not suffice(len(candidates)):
            return None
        return next(filter(suffice, range(1, len(candidates))), len(candidates))

    chosen = every[:most]
    reached = chance_of(known, shown, chosen)
    if not rollouts and reached.right < PLANNING.wanted:
        chosen = chosen[: fewest(reached.right - PLANNING.least_chance_gain, chosen)]
    random = explored.random(len(chosen))
    outlook = Outlook(
        chance_of(known, shown, chosen),
        chance_of(known, shown, random),
        fewest(PLANNING.wanted, every),
    )
    pairs = _pairs(known, shown, chosen, random)
    return _plan(explored, chosen, random, pairs=pairs, outlook=outlook)


def _informing(known: Known, explored: Explored, rollouts: int) -> Plan:
    """Returns the plan that narrows parameters; see :func:`_separating`."""
    information = [
        explored.judge.information(explored.played, k) for k in range(len(known.causes))
    ]
    chosen = rollouts_that_inform(known, information, explored.every, rollouts)
    random = explored.random(len(chosen))
    widths, gain = _widths(known, information, chosen, random)
    return _plan(explored, chosen, random, widths=widths, information=gain)


def _plan(
    explored: Explored,
    chosen: Sequence[int],
    random: Sequence[int],
    *,
    pairs: tuple[Pair, ...] = (),
    outlook: Outlook | None = None,
    widths: tuple[Width, ...] = (),
    information: float = math.nan,
) -> Plan:
    """Returns the plan of chosen candidates, and as many random ones."""
    judge, played = explored.judge, explored.played
    return Plan(
        _recording(judge, played, chosen),
        pairs,
        outlook,
        widths,
        information,
        judge.limits,
        explored.found,
        _recording(judge, played, random),
    )


def _pairs(
    known: Known, shown: Shown, chosen: Sequence[int], random: Sequence[int]
) -> tuple[Pair, ...]:
    """Returns the separations of all pairs; of the two directions, the smaller one."""
    added = [shown.squares(part) for part in (chosen, random)]

    def both(a: int, b: int) -> list[float]:
        before = float(known.separations[a, b])
        return [before, *(math.hypot(before, math.sqrt(s[a, b].sum())) for s in added)]

    return tuple(
        Pair(
            known.causes[a].name,
            known.causes[b].name,
            *(min(pair) for pair in zip(both(a, b), both(b, a), strict=True)),
        )
        for a, b in itertools.combinations(range(len(known.causes)), 2)
    )


def _widths(
    known: Known, information: Sequence[Tensor], chosen: Sequence[int], random: Sequence[int]
) -> tuple[tuple[Width, ...], float]:
    """Returns the widths of the parameters and the information, averaged over the causes."""
    widths, gains = [], []
    for cause, added in zip(known.causes, information, strict=True):
        every = [
            cause.precision,
            *(cause.precision + added[list(k)].sum(0) for k in (chosen, random)),
        ]
        widths.append([p.inverse().diagonal().sqrt().numpy() for p in every])
        gains.append(float(information_gain(every[0], every[1])))
    prior = prior_of(known.causes[0].model, known.time_step)
    names = [
        site.name if width == 1 else f"{site.name}[{k}]"
        for site in prior.sites
        for width in (site.coordinates.stop - site.coordinates.start,)
        for k in range(width)
    ]
    mean = np.mean(widths, axis=0)
    return (
        tuple(Width(name, *mean[:, k].tolist()) for k, name in enumerate(names)),
        float(np.mean(gains)),
    )


def _recording(judge: Judge, played: Played, chosen: Sequence[int]) -> Rollouts:
    """Returns commands of candidates with the measurements that the first cause predicts."""
    simulator = judge.known.causes[0].simulator
    units = {c.name: c.unit for c in (*simulator.sensors, *simulator.actions)}
    return Rollouts.from_arrays(
        [np.concatenate((played.start[k][None], played.readings[0, k])) for k in chosen],
        [played.commands[k] for k in chosen],
        channel_names=judge.channels,
        action_names=judge.actions,
        time_step=judge.limits.time_step,
        channel_units=[units.get(name, "") for name in judge.channels],
        action_units=[units.get(name, "") for name in judge.actions],
    )
