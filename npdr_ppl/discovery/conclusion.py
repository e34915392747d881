"""What follows from a search and its proof: a verdict, or a learned law where no effect fits."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Verdict
from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.result import Learned
from npdr_ppl.discovery.predictions import Predictions
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.discovery.search.rounds import Round, Search, explained
from npdr_ppl.discovery.verdict import judge, most_doubtful

__all__ = ["Conclusion", "conclusion_of", "with_law"]


@dataclass(frozen=True)
class Conclusion:
    """A verdict with what it is about.

    Attributes:
        verdict: One word; see :data:`~npdr_ppl.discovery.discovery_result.Verdict`.
        reason: The reason for it, in a sentence.
        search: The search; its last round and final model are those of the learned law, if it is
            offered.
        unexplained: Share of the misfit that the final model leaves and one law could explain.
        effects: The missing effects; the one that explains most comes first.
        parameters: Estimates of all parameters of the final model, by site.
        gap: Metrics on the held-out recording; empty without one.
        learned: The law that was learned, if any.
    """

    verdict: Verdict
    reason: str
    search: Search
    unexplained: float
    effects: list[Finding]
    parameters: dict[str, Estimate]
    gap: dict[str, Gap]
    learned: Learned | None = None

    def doubtful(self, options: DiscoveryOptions) -> str | None:
        """Returns the name of the effect that keeps the cause from being known, if one does.

        Args:
            options: Settings of the search.
        """
        if self.verdict == "ambiguous":
            return most_doubtful(self.effects, options).effect.name
        if self.verdict == "unknown" and self.effects:
            return self.effects[0].effect.name
        return None


def conclusion_of(
    search: Search,
    effects: list[Finding],
    parameters: dict[str, Estimate],
    gap: dict[str, Gap],
    options: DiscoveryOptions,
) -> Conclusion:
    """Returns what follows from a search of the catalogue.

    Args:
        search: The search.
        effects: What is said about the effects that it added.
        parameters: Estimates of all parameters of its final model, by site.
        gap: Metrics on the held-out recording; empty without one.
        options: Settings of the search.
    """
    unexplained = _unexplained(search)
    verdict, reason = judge(search, effects, unexplained, gap, options)
    return Conclusion(verdict, reason, search, unexplained, effects, parameters, gap)


def with_law(
    found: Conclusion,
    learned: Learned,
    predictions: Predictions,
    look: Callable[[Hypothesis], Round],
) -> Conclusion:
    """Returns what follows once laws were learned: they are offered if predictions gain by them.

    Args:
        found: What follows from the search of the catalogue.
        learned: The laws.
        predictions: What fitted models predict.
        look: Returns the alarm and the ranking of candidates for a model.
    """
    if not learned.is_offered:
        return replace(found, learned=learned)
    final = learned.model.hypothesis
    gap = predictions.gap(final)
    if gap and gap["rmse"].has_grown:
        learned = learned.withdrawn(
            f"{learned.reason} But the error on the held-out rollouts grows from "
            f"{gap['rmse'].before:.3g} to {gap['rmse'].after:.3g}."
        )
        return replace(found, learned=learned)
    search = replace(found.search, rounds=[*found.search.rounds, look(final)], final=final)
    kept = {effect.name for effect in learned.model.start.effects}
    return Conclusion(
        "learned",
        f"No effect that was searched explains the recording. {learned.reason}",
        search,
        _unexplained(search),
        [effect for effect in found.effects if effect.effect.name in kept],
        predictions.parameters(final),
        gap,
        learned,
    )


def _unexplained(search: Search) -> float:
    """Returns the share of the misfit that a further law could explain in the final model."""
    done = explained(search.rounds[0].hypothesis, search.final)
    left = search.rounds[-1].alarm.gain
    return left / max(left + done, 1e-12)
