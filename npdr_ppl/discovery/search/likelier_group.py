"""Several effects together that are likelier than those that were added one after another."""

import math
from collections.abc import Callable, Sequence

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.groups import Group, num_counted
from npdr_ppl.discovery.search.alternatives import log_prior
from npdr_ppl.discovery.search.convergence import converge_likeliest
from npdr_ppl.discovery.search.evidence import weigh
from npdr_ppl.discovery.search.settings import SEARCH, TRIALS
from npdr_ppl.discovery.search.shortlist import fit_groups
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.progress import Step

__all__ = ["likelier_group"]


def likelier_group(
    before: Hypothesis,
    groups: Sequence[Group],
    current: Hypothesis,
    trials: Trials,
    *,
    num_new: int,
    num_candidates: int,
    confidence: float,
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
) -> Hypothesis | None:
    """Returns the model with the best group, if it is likelier than the present model.

    Args:
        before: The model without the effects that a group would replace.
        groups: Groups to add to it, the largest joint gain first; only the first ones are fitted.
        current: The present model.
        trials: Fits the model.
        num_new: As how many effects a group counts a priori: the same law at several joints is
            one.
        num_candidates: Number of candidates, which share the prior probability of an effect.
        confidence: Probability that the group must have. One that is only slightly likelier may
            be so by chance.
        report: Called with a sentence about each group.
        progress: Called with the fraction of the groups that is fitted.

    Returns:
        ``None`` if no group is likelier.
    """
    tried = fit_groups(trials, before, groups[: TRIALS.pairs], current, report, progress)
    if tried:
        tried = {
            name: trial
            for name, trial in converge_likeliest(
                trials, tried, current, done={"": current}, most=TRIALS.most_converged + 1
            ).items()
            if name
            and trials.apart_from_waves_in_step(
                {name: trial}, len(trial.effects) - len(before.effects)
            )
        }
    if not tried:
        return None
    each = math.log(SEARCH.prior_of_any / max(1, num_candidates))
    hypotheses = [current, *tried.values()]
    known = num_counted(before.effects)
    counted = [num_counted(current.effects), *[known + num_new for _ in tried]]
    prior = [each * n + log_prior(h) for n, h in zip(counted, hypotheses, strict=True)]
    weights = dict(zip(("", *tried), weigh(hypotheses, prior), strict=True))
    best = max(weights, key=lambda name: weights[name])
    if not best or weights[best] <= confidence:
        return None
    report(f"{best} together are likelier")
    return tried[best]
