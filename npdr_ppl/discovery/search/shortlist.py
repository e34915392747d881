"""Short fits of the most promising candidates, and of groups of them."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.groups import Group
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.evidence import closest, log_evidence
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.preparation.closest_fit import part_of
from npdr_ppl.progress import Step

__all__ = [
    "enough_segments",
    "fit_groups",
    "fit_shortlist",
]


def fit_shortlist(
    trials: Trials,
    current: Hypothesis,
    ranking: Sequence[Screened],
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
    stops: Callable[[], bool] = lambda: False,
    *,
    offsets: Tensor | None = None,
) -> dict[str, Hypothesis]:
    """Fits the hypothesis with each candidate of the shortlist.

    Each candidate is fitted from its linear estimate, and also from its typical size if its
    change is not linear.

    The best candidates come first. Those whose linear gain is too small to match the best fit
    so far are skipped. Candidates that cannot be simulated are left out.

    Where the best candidate explains very much, a part of the segments shows which candidates
    explain most. The fits are then made along this part; the functions of
    :mod:`npdr_ppl.discovery.search.convergence` fit the best of them along all segments.

    Args:
        trials: Fits the model.
        current: The hypothesis.
        ranking: The candidates, the best first.
        report: Called with a sentence about each candidate.
        progress: Called with the fraction of the shortlist that is fitted.
        stops: Returns whether to leave out the candidates that are not fitted yet.
        offsets: Initial guess of the offsets of the initial states, ``(S, m)``; those of the
            hypothesis by default.
    """
    if offsets is None:
        offsets = current.fit.offsets
    if ranking:
        num = enough_segments(current, _promised(current, ranking[0].gain))
        if num < current.segments.inputs.num_segments:
            index = part_of(current.segments, num)
            few, along = Trials(trials.base.along(index)), current.along(index)
            return _fit_each(few, along, ranking, offsets[index], report, progress, stops)
    return _fit_each(trials, current, ranking, offsets, report, progress, stops)


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
    offsets: Tensor,
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
        starts = current.segments.starts
        asked = [
            (c, trials.extension(current, (c.variant.effect,), guess, starts, offsets))
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
