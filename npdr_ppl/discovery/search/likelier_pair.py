"""Two effects that are likelier than the two that were added one after another."""

import math
from collections.abc import Callable, Sequence

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.pairs import Pair
from npdr_ppl.discovery.search.alternatives import log_prior
from npdr_ppl.discovery.search.evidence import weigh
from npdr_ppl.discovery.search.settings import SEARCH, TRIALS
from npdr_ppl.discovery.search.shortlist import fit_contenders, fit_pairs
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.progress import Step

__all__ = ["likelier_pair"]


def likelier_pair(
    before: Hypothesis,
    pairs: Sequence[Pair],
    current: Hypothesis,
    trials: Trials,
    *,
    num_candidates: int,
    confidence: float,
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
) -> Hypothesis | None:
    """Returns the model with the best pair, if it is likelier than the present model.

    Args:
        before: The model without the effects that a pair would replace.
        pairs: Pairs to add to it, the largest joint gain first; only the first ones are fitted.
        current: The present model.
        trials: Fits the model.
        num_candidates: Number of candidates, which share the prior probability of an effect.
        confidence: Probability that the pair must have. A pair that is only slightly likelier may
            be so by chance.
        report: Called with a sentence about each pair.
        progress: Called with the fraction of the pairs that is fitted.

    Returns:
        ``None`` if no pair is likelier.
    """
    # Losses can be compared only if initial states and their errors are the same.
    starts = current.segments.starts
    tried = fit_pairs(trials, before, pairs[: TRIALS.pairs], starts, report, progress)
    if tried:
        tried = trials.apart_from_waves_in_step(fit_contenders(trials, tried, before), num_new=2)
    if not tried:
        return None
    each = math.log(SEARCH.prior_of_any / max(1, num_candidates))
    hypotheses = [current, *tried.values()]
    prior = [each * len(h.effects) + log_prior(h) for h in hypotheses]
    weights = dict(zip(("", *tried), weigh(hypotheses, prior), strict=True))
    best = max(weights, key=lambda name: weights[name])
    if not best or weights[best] <= confidence:
        return None
    report(f"{best} together are likelier")
    return tried[best]
