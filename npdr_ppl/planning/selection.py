"""Chooses the rollouts of a recording among candidates: how many, and which."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.planning.causes import Known
from npdr_ppl.planning.chances import Chance, chance_of_naming
from npdr_ppl.planning.separations import Shown, information_gain
from npdr_ppl.planning.settings import PLANNING

__all__ = ["certainty", "chance_of", "greedy", "rollouts_that_inform", "rollouts_that_separate"]


def greedy(
    pool: Sequence[int],
    value_of: Callable[[list[int]], float],
    is_enough: Callable[[list[int]], bool],
    *,
    most: int,
    num_distinct: int,
) -> list[int]:
    """Adds the member that gains most, again and again.

    A rollout that is recorded twice tells less than predicted: the errors of encoders are the same
    both times, so that they do not average out.

    Args:
        pool: Members to choose from.
        value_of: Value of a set.
        is_enough: Whether a set needs no further member.
        most: Greatest number of members.
        num_distinct: Number of members that differ from each other, as far as there are enough.
            Further ones repeat these.
    """
    chosen: list[int] = []
    while len(chosen) < most and not (chosen and is_enough(chosen)):
        unused = [k for k in pool if k not in chosen] if len(chosen) < num_distinct else []
        others = unused or list(dict.fromkeys(chosen))
        chosen.append(max(others, key=lambda k: value_of([*chosen, k])))
    return chosen


def rollouts_that_separate(
    known: Known,
    shown: Shown,
    pool: Sequence[int],
    *,
    least: int,
    most: int,
    num_distinct: int,
) -> list[int]:
    """Returns the fewest candidates after which the right cause is expected to be named.

    They are all that are allowed if these do not suffice.

    Args:
        known: The causes.
        shown: What the candidates would show.
        pool: The candidates to choose from.
        least: Least number of rollouts.
        most: Greatest number of rollouts.
        num_distinct: Number of rollouts that are recorded, which differ. Further ones are only
            counted.
    """

    def is_enough(chosen: list[int]) -> bool:
        return len(chosen) >= least and chance_of(known, shown, chosen).right >= PLANNING.wanted

    return greedy(
        pool,
        lambda chosen: certainty(known, shown, chosen),
        is_enough,
        most=most,
        num_distinct=num_distinct,
    )


def rollouts_that_inform(
    known: Known, information: Sequence[Tensor], pool: Sequence[int], number: int
) -> list[int]:
    """Returns the candidates that together inform most about the parameters.

    Args:
        known: The causes.
        information: What each candidate adds to a cause's precision, ``(E, d, d)`` per cause.
        pool: The candidates to choose from.
        number: Number of rollouts.
    """

    def gain(chosen: list[int]) -> float:
        return sum(
            float(information_gain(cause.precision, cause.precision + added[chosen].sum(0)))
            for cause, added in zip(known.causes, information, strict=True)
        )

    return greedy(pool, gain, lambda chosen: False, most=number, num_distinct=number)


def chance_of(known: Known, shown: Shown, chosen: Sequence[int]) -> Chance:
    """Returns the chance that discovery names the right cause after some candidates."""
    return chance_of_naming(known.probabilities, shown.squares(chosen))


def certainty(known: Known, shown: Shown, chosen: Sequence[int]) -> float:
    """Returns how well candidates tell the causes apart together; more is better.

    It is the bound of :meth:`~npdr_ppl.planning.judging.Judge.certainty`, over both directions of
    every pair.
    """
    likely = known.probabilities
    squares = shown.squares(chosen)
    terms = [
        0.5 * math.log(likely[a] * likely[b]) - float(np.log1p(squares[a, b] / 8.0).sum())
        for a, b in itertools.permutations(range(len(likely)), 2)
    ]
    return -float(torch.tensor(terms).logsumexp(0))
