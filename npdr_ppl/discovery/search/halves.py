"""The whole search, repeated in each half of a recording.

:mod:`~npdr_ppl.discovery.search.repeatability` compares the strengths of effects that were found.
This asks whether they are found at all by someone who has only half of the recording.
"""

from collections.abc import Mapping

import torch

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.effect_search import Search, Searcher
from npdr_ppl.discovery.search.parsimony import overlap
from npdr_ppl.discovery.search.settings import EVIDENCE, REPEATABILITY
from npdr_ppl.language.effects import Effect

__all__ = ["HALVES", "found_in_halves", "search_halves"]

HALVES = "the first half", "the second half"
"""Names of the halves."""


def search_halves(searcher: Searcher, first: Hypothesis, *, max_effects: int) -> dict[str, Search]:
    """Searches both halves of a recording.

    Args:
        searcher: The searcher of the whole recording.
        first: The original model, fitted to the whole recording.
        max_effects: Greatest number of effects.

    Returns:
        The result for each half; empty if the recording has too few segments.
    """
    num = searcher.base.inputs.num_segments
    if num < REPEATABILITY.fewest_segments:
        return {}
    found = {}
    for name, index in zip(HALVES, torch.arange(num).tensor_split(2), strict=True):
        half = searcher.along(index)
        own = half.fit_base(near=first.parameters)
        found[name] = half.run(half.look(own), max_effects=max_effects)
    return found


def found_in_halves(effect: Effect, halves: Mapping[str, Search]) -> dict[str, bool]:
    """Returns in which halves an effect was found.

    Another form of the same law counts, and an effect that the half cannot tell from it.

    Args:
        effect: The effect.
        halves: The results for both halves.
    """
    return {
        name: any(_stands_for(added, effect) for added in search.added)
        for name, search in halves.items()
    }


def _stands_for(added: Added, effect: Effect) -> bool:
    """Returns whether an effect of a half is, or could be, another one."""
    likely = added.alternatives.get(effect.name, 0.0) >= EVIDENCE.least_probability
    return likely or effect.name in added.fitting or overlap(added.effect, effect)
