"""Random search with refinement over excitations, deterministic with its seed."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.planning.excitations import Candidate, Excitations
from npdr_ppl.planning.judging import Judge, Played
from npdr_ppl.planning.settings import PLANNING
from npdr_ppl.progress import Step

__all__ = ["Found", "played_by", "search_excitations", "within_limits"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """The result of a search.

    Attributes:
        pool: The candidates that were refined last, the best first; the best random ones, which
            differ more; and further good ones. None if none was within the limits.
        random: The first random candidates within the limits: random recordings.
        num_judged: Number of candidates that were judged.
        has_stopped: Whether the time limit ended the search.
    """

    pool: tuple[Candidate, ...]
    random: tuple[Candidate, ...]
    num_judged: int
    has_stopped: bool


class _Ranked:
    """The best candidates so far, the best random ones, and the first ones."""

    def __init__(self) -> None:
        self.best: list[tuple[float, Candidate]] = []
        self.varied: list[tuple[float, Candidate]] = []
        self.first: list[Candidate] = []
        self.num_judged = 0

    def add(self, candidates: list[Candidate], values: Array, *, are_random: bool) -> bool:
        """Adds candidates; returns whether one is better than the best so far."""
        before = self.best[0][0] if self.best else -np.inf
        self.num_judged += len(candidates)
        found = [(float(v), c) for v, c in zip(values, candidates, strict=True) if np.isfinite(v)]
        self.best = sorted([*self.best, *found], key=lambda pair: -pair[0])
        self.best = self.best[: PLANNING.pool]
        if are_random:
            self.first = [*self.first, *(c for _, c in found)][: PLANNING.pool]
            self.varied = list(self.elites)
        return bool(self.best) and self.best[0][0] > before

    @property
    def elites(self) -> list[tuple[float, Candidate]]:
        """Those that are refined."""
        return self.best[: PLANNING.elites]


def search_excitations(
    excitations: Excitations,
    judge: Judge,
    value_of: Callable[[Played], Array],
    *,
    rounds: int,
    time_limit: float,
    progress: Step = lambda fraction, status: None,
) -> Found:
    """Searches the excitation with the greatest value within the limits.

    Args:
        excitations: Makes candidates.
        judge: Simulates them.
        value_of: Returns the values of candidates, ``(E,)``.
        rounds: Number of batches, the random ones included.
        time_limit: Seconds after which no further batch would end.
        progress: Called with the fraction of the batches that is done.
    """
    begin, ranked, step = time.monotonic(), _Ranked(), PLANNING.step
    num = judge.batch * PLANNING.tried_per_place
    has_stopped = False
    for number in range(rounds):
        spent = time.monotonic() - begin
        # Another batch takes as long as those before.
        if number and spent * (1.0 + 1.0 / number) > time_limit:
            has_stopped = True
            break
        progress(number / rounds, f"{ranked.num_judged} excitations judged")
        is_first = number < PLANNING.first_batches or not ranked.elites
        made = (
            excitations.random(num)
            if is_first
            else _refined(excitations, ranked.elites, step, num)
        )
        candidates, played = within_limits(excitations, judge, made)
        values = value_of(played) if candidates else np.zeros(0)
        if not ranked.add(candidates, values, are_random=is_first) and not is_first:
            step = max(PLANNING.least_step, PLANNING.shrink * step)
    pool: list[Candidate] = []
    for _, candidate in (*ranked.elites, *ranked.varied, *ranked.best):
        if not any(candidate is kept for kept in pool):
            pool.append(candidate)
    return Found(tuple(pool), tuple(ranked.first), ranked.num_judged, has_stopped)


def _refined(
    excitations: Excitations, elites: list[tuple[float, Candidate]], step: float, num: int
) -> list[Candidate]:
    """Returns candidates close to the best ones, and mixtures of these."""
    result = []
    for number in range(num):
        _, parent = elites[number % len(elites)]
        if number % 4 == 3:
            _, other = elites[(number + 1) % len(elites)]
            parent = excitations.mixed(parent, other)
        # Wide and narrow steps in turn: the best width differs along the search.
        result.append(excitations.changed(parent, step * (1.0, 0.3)[number % 2]))
    return result


def within_limits(
    excitations: Excitations, judge: Judge, made: list[Candidate]
) -> tuple[list[Candidate], Played]:
    """Returns the first candidates, at most a batch, whose simulations keep the limits.

    As long as half a batch is missing, those that do not are tried again, weaker.
    """
    kept: list[Candidate] = []
    parts: list[Played] = []
    for _ in range(PLANNING.most_weaker):
        played = played_by(excitations, judge, made)
        violation = judge.violation(played)
        room = judge.batch - len(kept)
        good = [k for k in range(len(made)) if violation[k] <= 0.0][:room]
        kept += [made[k] for k in good]
        parts.append(played.chosen(good))
        made = [
            excitations.weaker(made[k], 0.9 / (1.0 + min(violation[k], 4.0)))
            for k in range(len(made))
            if violation[k] > 0.0
        ]
        if 2 * len(kept) >= judge.batch or not made:
            break
    return kept, Played.joined(parts)


def played_by(excitations: Excitations, judge: Judge, candidates: Sequence[Candidate]) -> Played:
    """Returns what every cause simulates of some candidates."""
    return judge.played(
        np.stack([excitations.commands(c) for c in candidates]),
        np.stack([excitations.start(c) for c in candidates]),
    )
