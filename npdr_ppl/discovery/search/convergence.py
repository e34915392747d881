"""Fits, until convergence, of the candidates that are likeliest after short fits."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.evidence import closest, evidence, log_evidence
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.discovery.search.trials import Fit, Trials, refit
from npdr_ppl.preparation.closest_fit import part_of
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.progress import Step

__all__ = ["converge_along_best", "converge_likeliest"]


def converge_likeliest(
    trials: Trials,
    tried: Mapping[str, Hypothesis],
    current: Hypothesis,
    *,
    done: Mapping[str, Hypothesis] | None = None,
    most: int = TRIALS.most_converged,
    progress: Step = lambda fraction, status: None,
) -> dict[str, Hypothesis]:
    """Fits the likeliest trials until convergence.

    None is fitted whose loss is far above the least, that of models which are ``done`` included.
    The offsets of the initial states begin at those of the closest of these. A model that lacks
    much has others, from which a fit may end in a local minimum.

    Args:
        trials: Fits the model.
        tried: The model with each of several effects, all along the same segments.
        current: A model along all segments, whose initial states are used.
        done: Models to compare them with whose fits have converged, along all segments, with the
            same initial states.
        most: Greatest number of fits that converge, with those of ``done`` that are likelier.
        progress: Called with the fraction of these trials that has converged.

    Returns:
        The models along all segments, those that are ``done`` included. Trials that were made
        along a part of the segments are left out unless they were fitted again.
    """
    result = dict(done or {})
    if not tried:
        return result
    part = next(iter(tried.values())).segments
    num_segments = current.segments.inputs.num_segments
    is_part = part.inputs.num_segments < num_segments
    known = result
    if is_part:
        index = part_of(current.segments, part.inputs.num_segments)
        known = {name: hypothesis.along(index) for name, hypothesis in result.items()}
    compared = {**known, **tried}
    chosen = [name for name in _close_ones(compared, most) if name in tried]
    if not is_part:
        result |= tried

    offsets = closest(list(done.values())).fit.offsets if done else None

    def asked(name: str) -> Fit:
        trial = tried[name]
        if not is_part:
            return refit(trial.segments, trial, trial.effects, {}, offsets)
        fit = _whole(trials, trial, current)
        return fit if offsets is None else replace(fit, offsets=offsets)

    result |= _fitted(trials, {name: asked(name) for name in chosen}, progress)
    for name in _likeliest(compared):
        if not is_part or not chosen or not result.keys().isdisjoint(chosen):
            break
        # None of the likeliest can be simulated along all segments.
        if name in tried and name not in chosen:
            result |= _fitted(trials, {name: asked(name)})
    return result


def converge_along_best(
    trials: Trials,
    tried: Mapping[str, Hypothesis],
    current: Hypothesis,
    *,
    progress: Step = lambda fraction, status: None,
    stops: Callable[[], bool] = lambda: False,
) -> dict[str, Hypothesis]:
    """Fits the likeliest trials until convergence, with initial states of the best one's motion.

    The initial states are those of the model without the candidates, as in
    :func:`converge_likeliest`, unless a candidate explains very much. That model is then far off,
    and its initial states favour alternatives that can compensate for their errors: behind stiff
    servos, a delay of all sensors over one of all commands. So they are then estimated along the
    motion of the likeliest trial.

    Args:
        trials: Fits the model.
        tried: The model with each of several effects, all along the same segments.
        current: The model without them, along all segments.
        progress: Called with the fraction of these trials that has converged.
        stops: Returns whether the time is over. Then trials along all segments stay as they are.

    Returns:
        The models along all segments.
    """
    if not tried:
        return {}
    part = next(iter(tried.values())).segments
    whole, num = current.segments.inputs.num_segments, part.inputs.num_segments
    if num == whole and stops():
        return dict(tried)
    # A part is enough only where the best candidate explains very much.
    is_much = num < whole or (
        log_evidence(current, closest(list(tried.values()))) > TRIALS.enough_evidence
    )
    # Along all segments, no trial is left as it is, because its initial states are others.
    most = TRIALS.most_converged if num < whole else len(tried)
    names = _close_ones(tried, most) if is_much else []
    if not names:
        return converge_likeliest(trials, tried, current, progress=progress)
    first, *others = names
    best: Hypothesis | None = tried[first]
    if num < whole:
        begun = replace(_whole(trials, tried[first], current), is_trial=True)
        (best,) = trials.fits([begun], current.simulator)
    starts = None if best is None else best.estimated_starts()
    if starts is not None:
        progress(0.0, f"0 of {len(names)} best fits converged")
        (best,) = trials.fits([_whole(trials, tried[first], current, starts)], current.simulator)
    if starts is None or best is None or not best.can_be_linearised:
        return converge_likeliest(trials, tried, current, progress=progress)
    # Where a joint sticks, there are several minima; from the same offsets, alike laws end in the
    # same one.
    offsets = best.fit.offsets
    asked = {
        name: replace(_whole(trials, tried[name], current, starts), offsets=offsets)
        for name in others
    }
    return {first: best} | _fitted(trials, asked, progress, num_done=1)


def _fitted(
    trials: Trials,
    asked: Mapping[str, Fit],
    progress: Step = lambda fraction, status: None,
    *,
    num_done: int = 0,
) -> dict[str, Hypothesis]:
    """Returns the fits that can be made, by name.

    Args:
        trials: Fits the model.
        asked: The fits.
        progress: Called with the fraction of all that has converged.
        num_done: Number of others that have converged before.
    """
    num, found = num_done + len(asked), dict[str, Hypothesis]()
    if num:
        progress(num_done / num, f"{num_done} of {num} best fits converged")
    fits = trials.fits(list(asked.values()), trials.base.simulator)
    for number, (name, fit) in enumerate(zip(asked, fits, strict=True), num_done + 1):
        if fit is not None:
            found[name] = fit
        progress(number / num, f"{number} of {num} best fits converged")
    return found


def _whole(
    trials: Trials, trial: Hypothesis, current: Hypothesis, starts: InitialStates | None = None
) -> Fit:
    """Returns the fit of a trial along all segments.

    Args:
        trials: Fits the model.
        trial: The trial.
        current: A model along all segments, whose initial states are used by default.
        starts: Other initial states.
    """
    segments = trials.with_effects(trial.effects, starts or current.segments.starts)
    assert segments is not None
    offsets = current.fit.offsets if starts is None else segments.no_offsets
    return refit(segments, trial, trial.effects, {}, offsets)


def _close_ones(compared: Mapping[str, Hypothesis], most: int) -> list[str]:
    """Returns the names of the likeliest models whose loss is not far above the least.

    Args:
        compared: Models along the same segments, by name.
        most: Greatest number of names.
    """
    scale = closest(list(compared.values())).fit.scale
    losses = {name: float(trial.losses(scale).sum()) for name, trial in compared.items()}
    least = min(losses.values())
    most_lost = max(TRIALS.converged_loss, TRIALS.converged_share * abs(least))
    return [name for name in _likeliest(compared)[:most] if losses[name] <= least + most_lost]


def _likeliest(tried: Mapping[str, Hypothesis]) -> list[str]:
    """Returns the names of models along the same segments, the likeliest first.

    By loss alone, laws with more parameters would crowd out the simple law they contain.
    """
    models = list(tried.values())
    by_block = evidence(models, [0.0] * len(models), closest(models))
    likelihood = dict(zip(tried, by_block.sum(-1).tolist(), strict=True))
    return sorted(tried, key=lambda name: -likelihood[name])
