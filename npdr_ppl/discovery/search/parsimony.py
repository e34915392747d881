"""The fewest and simplest laws that explain nearly as much as all that were found.

A law of the catalogue only approximates a device. If something remains that no law of
the catalogue explains, a search adds laws that compensate for the difference between the first
laws and the device: dry friction is split into three laws, and a tilt or a wave takes the rest.
Each is significant, but none is a cause. A few laws that are left, each in its simplest form, are
the likelier causes; the others are added again if they do not overlap.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.groups import num_counted
from npdr_ppl.discovery.screening.projection import loss_without
from npdr_ppl.discovery.search.settings import EVIDENCE, PARSIMONY, TRIALS
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.language.effects import Effect

__all__ = ["lost_share", "overlap", "plausible_laws", "simplest_laws"]


def simplest_laws(
    base: Hypothesis,
    current: Hypothesis,
    candidates: Sequence[Effect],
    trials: Trials,
    report: Callable[[str], None] = lambda _: None,
) -> tuple[Hypothesis, frozenset[str]]:
    """Leaves out or simplifies laws, as long as little of the explanation is lost.

    This is for models that leave something unexplained, whose laws are approximations.

    Args:
        base: The original model.
        current: The model with all effects that were found.
        candidates: Effects that may be added to the original model.
        trials: Fits the model.
        report: Called with a sentence about each change.

    Returns:
        The model, and the names of its effects that together explain little. Of two that explain
        much together and can stand in for each other, as a delay and a lag, only one is among
        them.
    """
    left, minor = current, list[tuple[Effect, Mapping[str, Tensor]]]()
    reference = current
    while True:
        moves = dict(_simpler(base, reference, left, candidates, trials))
        shares = {move: lost_share(base, reference, found) for move, found in moves.items()}
        # A law with an implausible shape is not the cause, so what it explains beyond its simple
        # form does not count.
        implausible = [
            (effect, instead)
            for effect, instead in moves
            if instead
            and left.at_edge(effect)
            and shares[effect, instead] <= PARSIMONY.most_by_shape
        ]
        others = [move for move in moves if shares[move] <= VERDICT.minor_share]
        if not implausible and not others:
            break
        effect, instead = min(implausible or others, key=lambda move: shares[move])
        before, left = left, moves[effect, instead]
        if implausible:
            reference = left
        if instead:
            names = " and ".join(law.name for law in instead)
            report(f"{effect.name} becomes {names}: its shape explains too little")
        else:
            # It may have come as another law's simple form, which the first model does not have.
            minor.append((effect, {s: before.parameters[s] for s in effect.parameter_names}))
            report(f"{effect.name} is left out: it explains too little")
    if left is current:
        return current, frozenset()
    found = _with_minor(current, left, minor, trials, report)
    return found, frozenset(set(found.names) - set(left.names))


def plausible_laws(
    current: Hypothesis,
    candidates: Sequence[Effect],
    trials: Trials,
    report: Callable[[str], None] = lambda _: None,
    *,
    most: int,
) -> Hypothesis:
    """Replaces laws whose shape the recording does not tell.

    If the simpler laws that a law contains fit equally well, it takes their form: a drift that
    takes hours is friction. If another law beside it makes an implausible shape plausible, that
    law is added: a spring with a distant rest position is a spring and a constant force.

    This is for models that explain the recording; for others see :func:`simplest_laws`.

    Args:
        current: The model with all effects that were found.
        candidates: Effects that may be added to the original model.
        trials: Fits the model.
        report: Called with a sentence about each change.
        most: Greatest number of effects.
    """
    for effect in current.effects:
        options = _simple_forms(effect, current, candidates)
        if current.at_edge(effect):
            beside = _new_laws(effect, effect.beside, current, candidates)
            options += [(effect, law) for law in beside]
        others = tuple(e for e in current.effects if e.name != effect.name)
        options = [laws for laws in options if num_counted((*others, *laws)) <= most]
        found = trials.each_refitted(current, [(*others, *laws) for laws in options])
        # The fewest laws come first.
        for laws, trial in zip(options, found, strict=True):
            if trial is None or any(trial.at_edge(law) for law in laws):
                continue
            if current.share * _difference(trial, current, current) < EVIDENCE.indistinct_loss:
                if effect in laws:
                    report(f"{laws[-1].name} makes the shape of {effect.name} plausible")
                else:
                    names = " and ".join(law.name for law in laws)
                    report(f"{effect.name} becomes {names}: the recording does not tell its shape")
                current = trial
                break
    return current


def _simpler(
    base: Hypothesis,
    full: Hypothesis,
    left: Hypothesis,
    candidates: Sequence[Effect],
    trials: Trials,
) -> Iterator[tuple[tuple[Effect, tuple[Effect, ...]], Hypothesis]]:
    """Yields models without one effect or with simpler laws in its place, with the change."""
    explains = full.share * _difference(base, full, full)
    moves: list[tuple[Effect, tuple[Effect, ...]]] = []
    sets: list[tuple[Effect, ...]] = []
    for effect in left.effects:
        others = tuple(e for e in left.effects if e.name != effect.name)
        options = _simple_forms(effect, left, candidates)
        if others and not _is_essential(left, effect, explains):
            options.append(())
        moves += [(effect, instead) for instead in options]
        sets += [(*others, *instead) for instead in options]
    for move, found in zip(moves, trials.each_refitted(left, sets), strict=True):
        if found is not None:
            yield move, found


def _simple_forms(
    effect: Effect, current: Hypothesis, candidates: Sequence[Effect]
) -> list[tuple[Effect, ...]]:
    """Returns the simpler laws that an effect contains, each alone and all together."""
    simpler = _new_laws(effect, effect.contains, current, candidates)
    return [(law,) for law in simpler] + ([simpler] if len(simpler) > 1 else [])


def _new_laws(
    effect: Effect, ids: Collection[str], current: Hypothesis, candidates: Sequence[Effect]
) -> tuple[Effect, ...]:
    """Returns candidates at an effect's port, by their ids, that a hypothesis does not have."""
    return tuple(
        law
        for law in candidates
        if law.port == effect.port and law.id in ids and law.name not in current.names
    )


def _is_essential(hypothesis: Hypothesis, effect: Effect, explains: float) -> bool:
    """Returns whether the removal of an effect is not worth a try.

    The other effects are fitted again and can take over, so the linear estimate is too high.
    """
    if not hypothesis.can_be_linearised:
        return False
    return loss_without(hypothesis, effect) > PARSIMONY.largest_linear_share * explains


def _with_minor(
    full: Hypothesis,
    core: Hypothesis,
    minor: Sequence[tuple[Effect, Mapping[str, Tensor]]],
    trials: Trials,
    report: Callable[[str], None],
) -> Hypothesis:
    """Returns the core with the removed effects that it does not contain in another form.

    An effect that the core can take over was a part of one of its laws. Simulations are better
    with the others, even if they explain little.
    """
    for effect, start in reversed(minor):
        if any(overlap(effect, law) for law in core.effects):
            continue
        found = trials.refitted(core, (*core.effects, effect), start=start)
        gained = 0.0 if found is None else core.share * _difference(core, found, full)
        if found is not None and gained > TRIALS.certain_evidence:
            core = found
            report(f"{effect.name} is added again: it improves the simulation")
    return core


def lost_share(base: Hypothesis, full: Hypothesis, simpler: Hypothesis) -> float:
    """Returns the share of what a model explains that a simpler one does not explain.

    Args:
        base: The original model.
        full: The model with all effects.
        simpler: One with fewer or simpler effects.
    """
    return _difference(simpler, full, full) / max(_difference(base, full, full), 1e-12)


def overlap(one: Effect, other: Effect) -> bool:
    """Returns whether one of two effects at a port takes the place of the other."""
    if one.port != other.port:
        return False
    return one.id == other.id or _replaces(one, other) or _replaces(other, one)


def _replaces(one: Effect, other: Effect) -> bool:
    """Returns whether a law contains another one and is not attached beside it."""
    return other.id in one.contains and other.id not in one.beside


def _difference(one: Hypothesis, other: Hypothesis, reference: Hypothesis) -> float:
    """Returns by how much one hypothesis's loss exceeds another's, with a reference's scale."""
    scale = reference.fit.scale
    return float((one.losses(scale) - other.losses(scale)).sum())
