"""The rounds of a search and its result."""

from dataclasses import dataclass, field

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.alarm import Alarm
from npdr_ppl.discovery.screening.groups import Group
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.settings import SEARCH

__all__ = ["Round", "Search", "explained", "is_negligible", "is_something_left"]


@dataclass(frozen=True)
class Round:
    """The results for one set of effects.

    Attributes:
        hypothesis: The fitted model with these effects.
        averaged: The same, with averaged measurements if the recording is very long.
        alarm: Result of the test whether another effect is missing.
        ranking: The candidates by linear gain.
        separation: Distances between the best candidates; see :mod:`separation`.
        pairs: Pairs of the best candidates by joint linear gain.
        laws: Groups of the same law at several joints by joint linear gain.
        gain_by_channel: Linear gain of the best candidate by channel, ``(C,)``; ``None`` if no
            candidate has one.
        hopeless: Candidates that need not be fitted in full, by name.
        weights: Probability of each candidate fitted in full, by name; ``""`` for no effect.
        trials: The model with each of these candidates, by name.
    """

    hypothesis: Hypothesis
    averaged: Hypothesis
    alarm: Alarm
    ranking: list[Screened]
    separation: Tensor
    pairs: list[Group] = field(default_factory=list)
    laws: list[Group] = field(default_factory=list)
    gain_by_channel: Tensor | None = None
    hopeless: frozenset[str] = frozenset()
    weights: dict[str, float] = field(default_factory=dict)
    trials: dict[str, Hypothesis] = field(default_factory=dict)


@dataclass(frozen=True)
class Search:
    """The result of the search.

    Attributes:
        rounds: The results before each addition, and at the end.
        final: The final model.
        added: Its effects.
        trials: The final model with each alternative in an effect's place, by the names of the
            effect and of the alternative.
        is_approximate: Whether something remains that no law of the catalogue explains.
        has_stopped: Whether a time limit ended it before all was tried.
    """

    rounds: list[Round]
    final: Hypothesis
    added: list[Added]
    trials: dict[tuple[str, str], Hypothesis]
    is_approximate: bool = False
    has_stopped: bool = False


def explained(first: Hypothesis, final: Hypothesis) -> float:
    """Returns the reduction of the misfit, in units of the measurements' variance."""
    scale = closest([first, final]).fit.scale
    return max(0.0, 2.0 * float((first.losses(scale) - final.losses(scale)).sum()))


def is_something_left(first: Round, now: Round) -> bool:
    """Returns whether more is missing than differences between integrators can explain."""
    if not now.alarm.fired:
        return False
    done = explained(first.hypothesis, now.hypothesis)
    if now.alarm.gain > SEARCH.least_unexplained * done:
        return True
    by_channel = now.gain_by_channel
    if by_channel is None:
        return False
    there = _explained_where(by_channel, first.hypothesis, now.hypothesis)
    return float(by_channel.sum()) > SEARCH.least_unexplained * there


def is_negligible(first: Hypothesis, current: Hypothesis, extended: Hypothesis) -> bool:
    """Returns whether the last addition explains a negligible share of all that was explained."""
    if extended is current:
        return True
    scale = closest([current, extended]).fit.scale
    by_channel = (current.squares(scale) - extended.squares(scale)).clamp_min(0.0)
    there = _explained_where(by_channel, first, extended)
    return explained(current, extended) < SEARCH.least_unexplained * there


def _explained_where(by_channel: Tensor, first: Hypothesis, final: Hypothesis) -> float:
    """Returns the reduction of the misfit in the channels in which another one is.

    Precise channels can make up nearly all of the reduction. A large misfit that is left in a
    channel with more noise is not small beside them. If both reductions are spread alike over C
    equal channels, the result is that over all channels.

    Args:
        by_channel: The other reduction by channel, ``(C,)``.
        first: The original model.
        final: The model whose reduction is returned.
    """
    scale = closest([first, final]).fit.scale
    fell = (first.squares(scale) - final.squares(scale)).clamp_min(0.0)
    place = by_channel / by_channel.sum().clamp_min(1e-300)
    return min(explained(first, final), len(place) * float(place @ fell))
