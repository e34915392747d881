"""Fits of the candidates of a round: short ones of many, then long ones of the likeliest."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.groups import Group
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.evidence import closest, evidence
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.discovery.search.trials import Fit, Trials, refit
from npdr_ppl.preparation.closest_fit import part_of
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.progress import Step

__all__ = [
    "enough_segments",
    "fit_contenders",
    "fit_groups",
    "fit_likeliest",
    "fit_shortlist",
    "log_evidence",
]


def fit_shortlist(
    trials: Trials,
    current: Hypothesis,
    ranking: Sequence[Screened],
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
    stops: Callable[[], bool] = lambda: False,
) -> dict[str, Hypothesis]:
    """Fits the hypothesis with each candidate of the shortlist.

    Each candidate is fitted from its linear estimate, and also from its typical size if its
    change is not linear.

    The best candidates come first. Those whose linear gain is too small to match the best fit
    so far are skipped. Candidates that cannot be simulated are left out.

    Where the best candidate explains very much, a part of the segments shows which candidates
    explain most. The fits are then made along this part; :func:`fit_contenders` fits the best of
    them along all segments.

    Args:
        trials: Fits the model.
        current: The hypothesis.
        ranking: The candidates, the best first.
        report: Called with a sentence about each candidate.
        progress: Called with the fraction of the shortlist that is fitted.
        stops: Returns whether to leave out the candidates that are not fitted yet.
    """
    if ranking:
        num = enough_segments(current, _promised(current, ranking[0].gain))
        if num < current.segments.inputs.num_segments:
            index = part_of(current.segments, num)
            few, along = Trials(trials.base.along(index)), current.along(index)
            return _fit_each(few, along, ranking, report, progress, stops)
    return _fit_each(trials, current, ranking, report, progress, stops)


def fit_contenders(
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

    Args:
        trials: Fits the model.
        tried: The model with each of several effects, all along the same segments.
        current: A model along all segments, whose initial states are used.
        done: Models to compare them with whose fits have converged, along all segments.
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
    contenders = [name for name in _contenders(compared, most) if name in tried]
    if not is_part:
        result |= tried

    def asked(name: str) -> Fit:
        trial = tried[name]
        if not is_part:
            return refit(trial.segments, trial, trial.effects, {})
        return _whole(trials, trial, current)

    num = len(contenders)
    progress(0.0, f"0 of {num} best fits converged")
    fits = trials.fits([asked(name) for name in contenders], current.simulator)
    for number, (name, longer) in enumerate(zip(contenders, fits, strict=True), 1):
        if longer is not None:
            result[name] = longer
        progress(number / num, f"{number} of {num} best fits converged")
    for name in _likeliest(compared):
        if not is_part or not contenders or not result.keys().isdisjoint(contenders):
            break
        # None of the likeliest can be simulated along all segments.
        if name in tried and name not in contenders:
            (found,) = trials.fits([asked(name)], current.simulator)
            result |= {} if found is None else {name: found}
    return result


def fit_likeliest(
    trials: Trials,
    tried: Mapping[str, Hypothesis],
    current: Hypothesis,
    *,
    progress: Step = lambda fraction, status: None,
) -> dict[str, Hypothesis]:
    """Fits the likeliest trials until convergence, all with the same initial states.

    The initial states are those of the model without the candidates, as in
    :func:`fit_contenders`. If a candidate explains very much, they are estimated along the motion
    of the likeliest trial. That model is then far off, and its initial states favour alternatives
    that can compensate for their errors: behind stiff servos, a delay of all sensors over one of
    all commands.

    Args:
        trials: Fits the model.
        tried: The model with each of several effects, all along the same segments.
        current: The model without them, along all segments.
        progress: Called with the fraction of these trials that has converged.

    Returns:
        The models along all segments.
    """
    if not tried:
        return {}
    part = next(iter(tried.values())).segments
    whole, num = current.segments.inputs.num_segments, part.inputs.num_segments
    # A part is enough only where the best candidate explains very much.
    is_much = num < whole or (
        log_evidence(current, closest(list(tried.values()))) > TRIALS.enough_evidence
    )
    # Along all segments, no trial is left as it is, because its initial states are others.
    most = TRIALS.most_converged if num < whole else len(tried)
    names = _contenders(tried, most) if is_much else []
    if not names:
        return fit_contenders(trials, tried, current, progress=progress)
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
        return fit_contenders(trials, tried, current, progress=progress)
    found = {first: best}
    progress(1 / len(names), f"1 of {len(names)} best fits converged")
    # Where a joint sticks, there are several minima; from the same offsets, alike laws end in the
    # same one.
    asked = [
        replace(_whole(trials, tried[name], current, starts), offsets=best.fit.offsets)
        for name in others
    ]
    fits = trials.fits(asked, current.simulator)
    for number, (name, longer) in enumerate(zip(others, fits, strict=True), 2):
        if longer is not None:
            found[name] = longer
        progress(number / len(names), f"{number} of {len(names)} best fits converged")
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


def fit_groups(
    trials: Trials,
    current: Hypothesis,
    groups: Sequence[Group],
    compared: Hypothesis,
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
) -> dict[str, Hypothesis]:
    """Fits the hypothesis with each of several groups of candidates, from linear estimates.

    As in :func:`fit_shortlist`, a part of the segments is enough where the best group, or the
    model that they are compared with, explains very much.

    Args:
        trials: Fits the model.
        current: The hypothesis.
        groups: The groups, the best first.
        compared: The model that they are compared with. Its initial states are used, because
            losses can be compared only if these and their errors are the same.
        report: Called with a sentence about each group.
        progress: Called with the fraction of the groups that is fitted.

    Returns:
        The model with each group, by the names of its members; groups that cannot be simulated
        are left out.
    """
    if groups:
        evidence_of_all = max(_promised(current, groups[0].gain), log_evidence(current, compared))
        is_same = compared.segments.starts is current.segments.starts
        num = enough_segments(current, evidence_of_all)
        if num < current.segments.inputs.num_segments:
            index = part_of(current.segments, num)
            trials = Trials(trials.base.along(index))
            # The same object, so that fits begin at the fitted offsets.
            current = current.along(index)
            compared = current if is_same else compared.along(index)
    starts = compared.segments.starts
    asked = [
        trials.extension(current, group.effects, group.parameters, starts) for group in groups
    ]
    tried: dict[str, Hypothesis] = {}
    fits = trials.fits(asked, current.simulator)
    for number, (group, found) in enumerate(zip(groups, fits, strict=True), 1):
        if found is not None:
            tried[group.name] = found
            report(f"tried {group.name}: {_shown(found)}")
        progress(number / len(groups), f"{number} of {len(groups)} groups fitted")
    return tried


def _fit_each(
    trials: Trials,
    current: Hypothesis,
    ranking: Sequence[Screened],
    report: Callable[[str], None],
    progress: Step,
    stops: Callable[[], bool],
) -> dict[str, Hypothesis]:
    """Fits the hypothesis with each candidate along its own segments."""
    tried: dict[str, Hypothesis] = {}
    waiting = list(ranking[: TRIALS.shortlist])
    done, planned = 0, len(waiting)

    def fitted(number: int) -> None:
        progress(number / planned, f"{number} of {planned} candidates fitted")

    while waiting and not (tried and stops()):
        fitted(done)
        present, waiting = (
            waiting[: TRIALS.candidates_per_decision],
            waiting[TRIALS.candidates_per_decision :],
        )
        asked = [
            (c, trials.extension(current, (c.variant.effect,), guess, current.segments.starts))
            for c in present
            for guess in _initial_guesses(c)
        ]
        fits = trials.fits([fit for _, fit in asked], current.simulator)
        found: dict[str, list[Hypothesis]] = {}
        for (candidate, _), trial in zip(asked, fits, strict=True):
            if trial is not None:
                found.setdefault(candidate.name, []).append(trial)
        for candidate in present:
            if candidate.name in found:
                tried[candidate.name] = _best(found[candidate.name])
                report(f"tried {candidate.name}: {_shown(tried[candidate.name])}")
            done += 1
            fitted(done)
        if tried:
            far = _far_behind(current, closest(list(tried.values())))
            waiting = [
                c for c in waiting if c.gain * TRIALS.largest_growth > far * ranking[0].gain
            ]
    return tried


def enough_segments(current: Hypothesis, evidence_of_all: float) -> int:
    """Returns how many segments show which candidates explain most.

    Args:
        current: The hypothesis.
        evidence_of_all: Log evidence for the best candidate along all segments.
    """
    num = current.segments.inputs.num_segments
    if evidence_of_all <= TRIALS.enough_evidence:
        return num
    return min(
        num, max(TRIALS.fewest_segments, math.ceil(num * TRIALS.enough_evidence / evidence_of_all))
    )


def log_evidence(current: Hypothesis, other: Hypothesis) -> float:
    """Returns the log evidence for another hypothesis than the current one.

    Args:
        current: The current one.
        other: The other one, along the same segments. The noise is what it leaves.
    """
    scale = other.fit.scale
    return other.share * float((current.losses(scale) - other.losses(scale)).sum())


def _contenders(compared: Mapping[str, Hypothesis], most: int) -> list[str]:
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


def _initial_guesses(candidate: Screened) -> list[dict[str, Tensor]]:
    """Returns the initial guesses of a candidate's fits.

    They are the linear estimate, and the typical size if the change is not linear. The linear
    estimate can then be far from the best fit, with a local minimum between them: a lag beside a
    delay that already explains their sum. Many sizes of a resonance are screened, and fits of
    effects with many minima restart by themselves. What was found on the recording itself needs no
    other guess.
    """
    variant, effect = candidate.variant, candidate.variant.effect
    guesses = [variant.parameters(candidate.sizes)]
    if not (
        variant.is_linear or effect.is_resonant or effect.has_local_minima or variant.is_hinted
    ):
        guesses.append(variant.parameters(torch.ones_like(candidate.sizes)))
    return guesses


def _best(trials: Sequence[Hypothesis]) -> Hypothesis:
    """Returns the hypothesis with the least loss."""
    scale = closest(trials).fit.scale
    return min(trials, key=lambda trial: float(trial.losses(scale).sum()))


def _far_behind(current: Hypothesis, best: Hypothesis) -> float:
    """Returns the share of the best trial's gain that another must reach to be an alternative."""
    return 1.0 - TRIALS.certain_evidence / max(
        log_evidence(current, best), TRIALS.certain_evidence
    )


def _promised(current: Hypothesis, gain: float) -> float:
    """Returns the log evidence for a candidate to first order, with the noise estimated anew.

    It is far less than :func:`log_evidence` of the fit if the candidate explains nearly all: how
    little it leaves is not known before.

    Args:
        current: The model without it.
        gain: Its linear gain, in units of the variance that the model leaves.
    """
    num = float(current.segments.num_measured.sum())
    return -0.5 * current.share * num * math.log(max(1.0 - gain / num, 1e-9))


def _shown(hypothesis: Hypothesis) -> str:
    return ", ".join(
        f"{name} {scale:.3g}"
        for name, scale in zip(
            hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True
        )
    )
