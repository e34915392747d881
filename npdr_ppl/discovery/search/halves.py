"""The whole search, repeated in each half of a recording.

:mod:`~npdr_ppl.discovery.search.repeatability` compares the strengths of effects that were found.
This asks whether a search of only half of the recording finds them at all.
"""

from collections.abc import Callable, Mapping

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.parsimony import overlap
from npdr_ppl.discovery.search.repeatability import halves
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.discovery.search.settings import EVIDENCE
from npdr_ppl.errors import DataError
from npdr_ppl.language.effects import Effect
from npdr_ppl.preparation.data_options import FEWEST_SEGMENTS

__all__ = ["found_in_halves", "missing_where", "search_halves"]


def search_halves(
    searcher: Searcher,
    first: Hypothesis,
    *,
    max_effects: int,
    report: Callable[[str], None] = lambda _: None,
) -> dict[str, Search]:
    """Searches both halves of a recording.

    Args:
        searcher: The searcher of the whole recording.
        first: The original model, fitted to the whole recording.
        max_effects: Greatest number of effects.
        report: Called with a sentence about each half.

    Returns:
        The result for each half. A half that cannot be fitted is left out, and so are both if they
        have fewer segments than a recording must have.
    """
    num = searcher.base.inputs.num_segments
    if num < 2 * FEWEST_SEGMENTS:
        return {}
    found = {}
    for name, index in halves(num):
        report(f"searching {name}")
        half = searcher.along(index)
        try:
            own = half.fit_base(near=first.parameters)
            found[name] = half.run(half.look(own), max_effects=max_effects)
        except DataError as error:
            report(f"{name} is left out: {error}")
    return found


def found_in_halves(effect: Effect, searches: Mapping[str, Search]) -> dict[str, bool]:
    """Returns in which halves an effect was found, by the half's name.

    Another form of the same law counts, and an effect that the half cannot tell from it.

    Args:
        effect: The effect.
        searches: The results for the halves.
    """
    return {
        name: any(_stands_for(added, effect) for added in search.added)
        for name, search in searches.items()
    }


def missing_where(in_halves: Mapping[str, bool]) -> str:
    """Returns where an effect was not found: the half's name, or ``"either half"``.

    Args:
        in_halves: Whether it was found in each half; see :func:`found_in_halves`.
    """
    missed = [name for name, is_in in in_halves.items() if not is_in]
    return missed[0] if len(missed) == 1 else "either half"


def _stands_for(added: Added, effect: Effect) -> bool:
    """Returns whether an effect of a half is, or could be, another one."""
    likely = added.alternatives.get(effect.name, 0.0) >= EVIDENCE.least_probability
    return likely or effect.name in added.fitting or overlap(added.effect, effect)
