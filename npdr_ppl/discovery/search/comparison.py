"""Each effect of a model against its alternatives: is another law likelier in its place?"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.alternatives import (
    Added,
    Alternatives,
    find_alternatives,
    tried_before,
    weigh_alternatives,
    with_simple_forms,
)
from npdr_ppl.discovery.search.rounds import Round
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.language.effects import Effect
from npdr_ppl.progress import Step

__all__ = ["compare_effects"]


def compare_effects(
    current: Hypothesis,
    rounds: Sequence[Round],
    trials: Trials,
    options: DiscoveryOptions,
    *,
    is_approximate: bool = False,
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
    stops: Callable[[], bool] = lambda: False,
) -> tuple[Hypothesis, list[Added], dict[tuple[str, str], Hypothesis]]:
    """Compares each effect with its alternatives, and replaces it if one is likelier.

    Args:
        current: The fitted model with all effects.
        rounds: The results of the search so far.
        trials: Fits the model.
        options: Settings of the search.
        is_approximate: Whether something remains that no law of the catalogue explains.
        report: Called with a sentence about each effect.
        progress: Called with the fraction of the effects that is compared.
        stops: Returns whether to compare the rest only with what the search has tried already.

    Returns:
        The final model, its effects, and the models with each alternative; see
        :class:`~npdr_ppl.discovery.search.rounds.Search`.
    """
    added: list[Added] = []
    tried: dict[tuple[str, str], Hypothesis] = {}
    waiting = current.effects
    num = len(waiting)
    while waiting:
        asked = current
        compared = num - len(waiting)
        progress(compared / num, f"{compared} of {num} effects compared")
        of_each = _alternatives(asked, waiting, rounds, trials, options, stops)
        for effect, (alternatives, is_tried) in zip(waiting, of_each, strict=True):
            waiting = waiting[1:]
            if alternatives is not None:
                alternatives = with_simple_forms(effect, alternatives, trials, stops)
            current, found = weigh_alternatives(
                rounds[0].hypothesis,
                asked,
                effect,
                alternatives,
                is_approximate=is_approximate,
            )
            if not is_tried:
                found = replace(found, is_compared=False)
                report(f"{effect.name}: not compared with alternatives")
            else:
                report(f"{effect.name}: probability {found.probability:.2f}")
            added.append(found)
            # Only models with the same initial states can be compared.
            models = {effect.name: asked}
            if alternatives is not None:
                models = {effect.name: alternatives.with_it} | alternatives.others
                models[""] = alternatives.without
            tried |= {(effect.name, name): model for name, model in models.items()}
            compared = num - len(waiting)
            progress(compared / num, f"{compared} of {num} effects compared")
            if current is not asked:
                current = trials.with_own_starts(current)
                break  # the other effects are compared together with the new one
    return current, added, tried


def _alternatives(
    current: Hypothesis,
    effects: Sequence[Effect],
    rounds: Sequence[Round],
    trials: Trials,
    options: DiscoveryOptions,
    stops: Callable[[], bool],
) -> Iterator[tuple[Alternatives | None, bool]]:
    """Yields the alternatives of each effect, in order, and whether they were tried.

    The alternatives are ``None`` if a time limit prevented them, or if the model cannot be
    simulated without the effect.
    """
    seen = [(r.hypothesis, r.trials) for r in rounds]
    known = {effect.name: tried_before(current, effect, seen) for effect in effects}
    new = [effect for effect in effects if known[effect.name] is None]
    function = partial(find_alternatives, current, trials=trials, options=options)
    number = num_processes(current.simulator)
    # With fewer effects than processes, it is faster if each search uses all processes.
    found = side_by_side(function, new, number if len(new) >= number else 1)
    has_stopped = False
    for effect in effects:
        if known[effect.name] is None:
            has_stopped = has_stopped or stops()
        if known[effect.name] is not None:
            yield known[effect.name], True
        else:
            yield (None, False) if has_stopped else (next(found), True)
