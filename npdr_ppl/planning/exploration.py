"""Searches excitations within limits, and simulates the best of them and random ones in full."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.planning.causes import Known
from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.judging import Judge, Played
from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.search import Found, played_by, search_excitations
from npdr_ppl.progress import Step

__all__ = ["Explored", "explore", "separates"]


@dataclass(frozen=True)
class Explored:
    """The result of a search, simulated in every cause.

    Attributes:
        judge: Predicts what the candidates would show.
        found: The course of the search.
        played: The best candidates, then random ones.
        num_pool: Number of the best ones.
        every: Indices of the candidates that a plan may use; of equal ones, the first.
    """

    judge: Judge
    found: Found
    played: Played
    num_pool: int
    every: Sequence[int]

    def random(self, number: int) -> list[int]:
        """Returns a number of random candidates, in turn if there are fewer."""
        members = range(self.num_pool, len(self.played.commands))
        return [members[k % len(members)] for k in range(number)]


def separates(known: Known) -> bool:
    """Returns whether there are several causes to tell apart, and not only parameters to find."""
    return len(known.causes) > 1 and not known.is_prior


def explore(
    known: Known,
    limits: Limits,
    *,
    num_candidates: int | None = None,
    rounds: int,
    time_limit: float,
    seed: int,
    progress: Step = lambda fraction, status: None,
) -> Explored:
    """Searches the excitations that tell the causes apart, or that narrow parameters.

    Args:
        known: The causes, at the time step of the limits.
        limits: What the robot may do.
        num_candidates: Greatest number of the best candidates that are returned, and of random
            ones; ``None`` for :attr:`~npdr_ppl.planning.judging.Judge.most_shown`.
        rounds: Number of batches.
        time_limit: Seconds after which no further batch begins.
        seed: Seed of the search.
        progress: Called with the fraction of the search that is done.

    Raises:
        DataError: No excitation keeps the limits in all causes.
    """
    excitations = Excitations(limits, np.random.default_rng(seed))
    judge = Judge(known, limits, seed)
    value_of = judge.certainty if separates(known) else judge.gains
    found = search_excitations(
        excitations, judge, value_of, rounds=rounds, time_limit=time_limit, progress=progress
    )
    if not found.pool:
        raise _nothing_found(known, judge, found)
    most = num_candidates or judge.most_shown
    pool, random = found.pool[:most], found.random[:most]
    played = played_by(excitations, judge, [*pool, *random])
    return Explored(judge, found, played, len(pool), _different(played))


def _different(played: Played) -> list[int]:
    """Returns the first of each group of candidates with the same commands and start."""
    found: dict[tuple[bytes, bytes], int] = {}
    for number, made in enumerate(zip(played.commands, played.start, strict=True)):
        commands, start = made
        found.setdefault((commands.tobytes(), start.tobytes()), number)
    return list(found.values())


def _nothing_found(known: Known, judge: Judge, found: Found) -> DataError:
    """Returns why no excitation was found."""
    if found.num_judged:
        return DataError(
            "The causes cannot be simulated in short segments of any excitation; the model may "
            "need smaller integration steps."
        )
    return DataError(
        f"None of {judge.num_simulated // len(known.causes)} simulated excitations kept the "
        "limits; allow more position, speed or acceleration, or search longer."
        + (f" A simulation failed: {judge.failure}" if judge.failure else "")
    )
