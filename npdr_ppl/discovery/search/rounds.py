"""The rounds of a search and its result."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.alarm import Alarm
from npdr_ppl.discovery.screening.groups import Group
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.settings import SEARCH

__all__ = [
    "Round",
    "Search",
    "explained",
    "is_negligible",
    "is_single_addition",
    "is_something_left",
]


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
        shares: Share of each channel in the change by each of the best candidates, ``(C,)``, by
            name.
        hopeless: Candidates that need not be fitted in full, by name.
        weights: Probability of each candidate fitted in full, by name; ``""`` for no effect.
        trials: The model with each of these candidates, by name.
        is_stale: Whether the model was fitted again, in other steps or priors, after the test.
    """

    hypothesis: Hypothesis
    averaged: Hypothesis
    alarm: Alarm
    ranking: list[Screened]
    separation: Tensor
    pairs: list[Group] = field(default_factory=list)
    laws: list[Group] = field(default_factory=list)
    shares: dict[str, Tensor] = field(default_factory=dict)
    hopeless: frozenset[str] = frozenset()
    weights: dict[str, float] = field(default_factory=dict)
    trials: dict[str, Hypothesis] = field(default_factory=dict)
    is_stale: bool = False

    @property
    def far_behind(self) -> frozenset[str]:
        """Candidates whose full fit was so bad that no small change can help, by name."""
        return frozenset(name for name, w in self.weights.items() if w < SEARCH.hopeless)

    def refitted(self, hypothesis: Hypothesis) -> "Round":
        """Returns the round with its model fitted again, without what was tried.

        Candidates that were far behind or did not come to a full fit are hopeless.

        Args:
            hypothesis: The model in other steps or priors.
        """
        not_fitted = {c.name for c in self.ranking if c.name not in self.weights}
        return replace(
            self,
            hypothesis=hypothesis,
            averaged=hypothesis.averaged(),
            weights={},
            trials={},
            hopeless=self.hopeless | self.far_behind | not_fitted,
            is_stale=True,
        )


@dataclass(frozen=True)
class Search:
    """The result of the search.

    Attributes:
        rounds: The results before each addition, and at the end.
        final: The final model.
        added: Its effects.
        trials: The final model with each alternative in an effect's place, by the names of the
            effect and of the alternative; ``""`` for the model without the effect. The
            alternatives of one place begin at the same initial states, so that their evidence can
            be compared.
        is_approximate: Whether something remains that no law of the catalogue explains.
        has_stopped: Whether a time limit ended it before all was tried.
        minor: Names of effects of an approximate model that together explain little.
    """

    rounds: list[Round]
    final: Hypothesis
    added: list[Added]
    trials: dict[tuple[str, str], Hypothesis]
    is_approximate: bool = False
    has_stopped: bool = False
    minor: frozenset[str] = frozenset()

    @property
    def missing(self) -> list[Added]:
        """Its effects, without those that correct a number of the model."""
        simulator = self.final.simulator
        return [each for each in self.added if not simulator.corrected_number(each.effect)]


def explained(first: Hypothesis, final: Hypothesis) -> float:
    """Returns the reduction of the misfit, in units of the measurements' variance."""
    scale = closest([first, final]).fit.scale
    return max(0.0, 2.0 * float((first.losses(scale) - final.losses(scale)).sum()))


def is_something_left(first: Round, now: Round) -> bool:
    """Returns whether more is missing than differences between integrators can explain."""
    alarm, before = now.alarm, first.hypothesis
    if not alarm.fired:
        return False
    if alarm.gain > SEARCH.least_unexplained * explained(before, now.hypothesis):
        return True
    return any(
        candidate.gain
        > SEARCH.least_unexplained
        * _explained_where(now.shares[candidate.name], before, now.hypothesis)
        for candidate in now.ranking
        if candidate.name in now.shares and alarm.p_values[candidate.name] <= alarm.limit
    )


def is_single_addition(rounds: Sequence[Round]) -> bool:
    """Returns whether the last round's model has one effect that the one before has not."""
    if len(rounds) < 2:
        return False
    return len(set(rounds[-1].hypothesis.names) - set(rounds[-2].hypothesis.names)) == 1


def is_negligible(first: Hypothesis, current: Hypothesis, extended: Hypothesis) -> bool:
    """Returns whether the last addition explains a negligible share of all that was explained."""
    added = 0.0 if extended is current else explained(current, extended)
    if added == 0.0:
        return True
    scale = closest([current, extended]).fit.scale
    reduction = (current.squares(scale) - extended.squares(scale)).clamp_min(0.0)
    shares = reduction / reduction.sum().clamp_min(1e-300)
    return added < SEARCH.least_unexplained * _explained_where(shares, first, extended)


def _explained_where(shares: Tensor, first: Hypothesis, final: Hypothesis) -> float:
    """Returns the reduction of the misfit, weighted by channel.

    A precise channel can hold nearly all of the reduction. A misfit in a noisy channel is compared
    with that channel's own reduction.

    Args:
        shares: Weight of each channel, ``(C,)``. With equal weights the result is the whole
            reduction, which it never exceeds.
        first: The original model.
        final: The model whose reduction is returned.
    """
    scale = closest([first, final]).fit.scale
    reduction = (first.squares(scale) - final.squares(scale)).clamp_min(0.0)
    return min(explained(first, final), len(shares) * float(shares @ reduction))
