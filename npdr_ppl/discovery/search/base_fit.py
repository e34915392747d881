"""The original model's fit to a recording: fit, compare, train and discover all begin with it.

The search for the closest parameters and initial states begins in the prior's middle, and, unless
the misfit has one minimum only, also at the result of a search of the whole prior. Then the
initial states are estimated again along the fitted motion, and the integration steps are refined
if they are too coarse for the recording.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import (
    Hypothesis,
    extended,
    fit_segment_model,
)
from npdr_ppl.discovery.kept_fits import made_or_read
from npdr_ppl.discovery.search.evidence import closest, weigh
from npdr_ppl.discovery.search.settings import BASE_FIT
from npdr_ppl.discovery.search.single_minimum import has_single_minimum
from npdr_ppl.discovery.search.trials import Trials, refit
from npdr_ppl.discovery.settings import HYPOTHESIS
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.preparation.closest_fit import part_of, search_prior
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import PRIOR_SEARCH
from npdr_ppl.progress import Step

__all__ = [
    "BaseFit",
    "fit_base",
    "in_finer_steps",
    "is_clearly_likelier",
    "off_the_ends",
    "polished",
    "searched_fit",
]


@dataclass(frozen=True)
class BaseFit:
    """A model fitted to a recording.

    Attributes:
        segments: The model along the recording, with finer steps if its own are too coarse.
        hypothesis: Its closest fit.
        are_steps_coarse: Whether its own steps are too coarse for the recording.
        is_polished: Whether a rough fit was fitted to convergence on the way; see
            :func:`polished`.
    """

    segments: SegmentModel
    hypothesis: Hypothesis
    are_steps_coarse: bool
    is_polished: bool = False


def fit_base(
    segments: SegmentModel,
    *,
    near: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    may_be_rough: bool = False,
    progress: Step | None = None,
) -> tuple[Hypothesis, Mapping[str, Tensor] | None]:
    """Fits a model to a recording, without adding effects.

    Unless it is rough, the fit of :func:`searched_fit`, whose arguments and results these are, is
    refined with initial states that are estimated along its own motion.

    Raises:
        DataError: No parameters can be simulated along the recording, or simulations fail close
            to the fit.
    """
    fitted, finer_parameters = searched_fit(
        segments, near=near, seed=seed, may_be_rough=may_be_rough, progress=progress
    )
    if finer_parameters is None:
        fitted = off_the_ends(fitted)
        if progress is not None:
            progress(None, "fit with better initial states")
        fitted = Trials(segments).with_own_starts(fitted)
    _ = fitted.linearisation  # computed now, because all later steps need it
    return fitted, finer_parameters


def searched_fit(
    segments: SegmentModel,
    *,
    near: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    may_be_rough: bool = False,
    progress: Step | None = None,
) -> tuple[Hypothesis, Mapping[str, Tensor] | None]:
    """Searches for the parameters closest to a recording, with the smoother's initial states.

    Args:
        segments: The model along the recording.
        near: Parameters near which the fit is expected; by default, and if they cannot be
            simulated, they are searched for.
        seed: Seed of the search.
        may_be_rough: Whether a rough fit is enough if the model's steps are too coarse for a part
            of the recording already: its parameters would only compensate for the steps.
        progress: Called with a short status, and during the search with the fraction of it done.

    Returns:
        The fit, and if it is rough, parameters from which a fit in finer steps may begin.

    Raises:
        DataError: No parameters can be simulated along the recording.
    """
    step = progress or (lambda fraction, status: None)
    begun: list[Hypothesis] = []
    failure: DataError | None = None
    few = segments.along(part_of(segments, seed=seed))

    def begin(start: Mapping[str, Tensor]) -> None:
        nonlocal failure
        # How many steps a fit takes is not known.
        step(None, f"rough fit {len(begun) + 1}")
        try:
            begun.append(fit_segment_model(few, start=start, is_rough=True))
        except DataError as error:
            failure = error

    begin(near or {})
    if not begun or not (near or has_single_minimum(few, seed=seed)):
        begin(_searched(segments, seed, progress))
    finer_parameters = None
    if may_be_rough and begun:
        step(None, "compare with finer integration steps")
        finer_parameters = _parameters_in_finer_steps(closest(begun), few)
    is_rough = finer_parameters is not None
    step(None, "rough fit" if is_rough else "fit to convergence")
    fitted: Hypothesis | None = None
    while begun and fitted is None:
        best = closest(begun)
        begun = [other for other in begun if other is not best]
        try:
            is_whole = len(best.fit.offsets) == segments.inputs.num_segments
            offsets = best.fit.offsets if is_whole else None
            fitted = fit_segment_model(
                segments, start=best.parameters, offsets=offsets, is_rough=is_rough
            )
        except DataError as error:  # it can be simulated along some segments only
            failure = error
    if fitted is None:
        assert failure is not None
        raise failure
    return fitted, finer_parameters


def _parameters_in_finer_steps(
    fitted: Hypothesis, segments: SegmentModel
) -> Mapping[str, Tensor] | None:
    """Returns the fit of a model in finer steps; ``None`` if its own are fine enough.

    Args:
        fitted: The model's fit in its own steps.
        segments: The model along the same segments.
    """
    try:
        # The fit along all segments refines them further if necessary.
        found = in_finer_steps(fitted, segments, is_rough=True, most_refinements=1)
    except DataError:
        return None
    return found.hypothesis.parameters if found.are_steps_coarse else None


def polished(rough: Hypothesis) -> Hypothesis:
    """Returns a hypothesis fitted to convergence, with initial states along its own motion.

    Args:
        rough: The hypothesis after rough steps.
    """
    trials = Trials(rough.segments)
    found = trials.refitted_along(rough.segments, rough, rough.effects)
    return rough if found is None else trials.with_own_starts(off_the_ends(found))


def off_the_ends(fitted: Hypothesis) -> Hypothesis:
    """Refits a model if parameters that the recording does not determine are at a prior's end.

    Along a flat direction, a fit can step anywhere. At a prior's end, a parameter hardly changes
    with its reference coordinate, so that the recording may say less about the coordinate than the
    prior does, and the fit cannot leave. The refit begins inside the prior. The fit with the
    greater posterior density is kept.

    Args:
        fitted: The fit.
    """
    for _ in range(BASE_FIT.most_refits):
        z = fitted.fit.z
        is_stuck = z.abs() > HYPOTHESIS.implausible_coordinate
        if bool(is_stuck.any()):
            is_stuck &= _is_flat(fitted)
        if not bool(is_stuck.any()):
            break
        inside = torch.where(is_stuck, z.sign(), z)
        start = fitted.segments.prior.to_parameters(inside[None])
        try:
            other = fit_segment_model(
                fitted.segments,
                effects=fitted.effects,
                start={name: value[0] for name, value in start.items()},
                offsets=fitted.fit.offsets,
            )
        except DataError:
            break
        before, after = (_loss(each, fitted.fit.scale, fitted.share) for each in (fitted, other))
        if not before - after >= BASE_FIT.least_gain:
            break
        fitted = other
    return fitted


def _is_flat(fitted: Hypothesis) -> Tensor:
    """Returns whether the prior says more about each coordinate than the recording, ``(d,)``."""
    fit = fitted.fit
    now = fitted.segments.linearise(fit.z, fit.offsets, fit.scale, is_rough=True)
    if not now.is_finite:
        return torch.ones(fit.z.shape, dtype=torch.bool)
    eye = torch.eye(len(fit.z), dtype=torch.float64)
    variance = torch.linalg.inv(fitted.share * now.information() + eye).diagonal()
    return variance > 0.5


def _loss(hypothesis: Hypothesis, scale: Tensor, share: float) -> float:
    """Returns minus the log density of a fit, up to a constant.

    Args:
        hypothesis: The fit.
        scale: Standard deviation of the measurements per channel, ``(C,)``.
        share: Effective number of measurements as a share of all.
    """
    misfit = share * float(hypothesis.losses(scale).sum())
    return misfit + 0.5 * float(hypothesis.fit.z.square().sum())


def in_finer_steps(
    current: Hypothesis,
    base: SegmentModel,
    *,
    near: Mapping[str, Tensor] | None = None,
    is_rough: bool = False,
    most_refinements: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> BaseFit:
    """Returns a fit with finer steps if the error of its own is noticeable; else unchanged.

    The error of coarse steps would be reported as a delay. If the recording itself was simulated
    with coarse steps, they are kept.

    Args:
        current: A fitted hypothesis of the model.
        base: The model without the effects of the hypothesis, along the recording.
        near: Parameters from which the first fit in finer steps begins; those of the hypothesis by
            default.
        is_rough: Whether a rough fit in finer steps is enough; see :func:`polished`.
        most_refinements: Greatest number of times that steps are refined; until they are fine
            enough by default.
        report: Called with a sentence when steps are refined.
    """
    is_coarse, is_polished, bases = False, False, [base]
    while (finer_base := _in_finer_steps(bases[-1])) is not None:
        bases.append(finer_base)
    for _ in range(most_refinements or len(bases)):
        levels = [extended(each, current.effects, current.segments.starts) for each in bases]
        # The first steps that differ little from the finest. A higher order alone does not show
        # the errors of forces that are held during a step.
        here = current.fit.z[None], current.fit.offsets[None]
        finest = levels[-1].simulate(*here) if len(levels) > 1 else None
        number = 0
        while (
            finest is not None
            and number < len(levels) - 1
            and _distance(current, levels[number].simulate(*here) - finest)
            > BASE_FIT.noticeable_change
        ):
            number += 1
        if number == 0:
            break
        trials = Trials(bases[number])
        asked = refit(levels[number], current, current.effects, near or {})
        (finer,) = trials.fits([replace(asked, is_trial=is_rough)], current.simulator)
        if finer is not None and not is_rough:
            finer = off_the_ends(finer)
        is_finer_polished = False
        if finer is not None and is_rough and not is_clearly_likelier(finer, current):
            # Rough fits do not show which is likelier.
            current = current if is_polished else polished(current)
            finer, is_polished, is_finer_polished = polished(finer), True, True
        if finer is None or is_clearly_likelier(current, finer):
            break
        report("the model's integration steps are too coarse for this recording; refining them")
        is_coarse, is_polished, bases = True, is_finer_polished, bases[number:]
        current, near = finer if is_rough else trials.with_own_starts(finer), None
    return BaseFit(bases[0], current, is_coarse, is_polished)


def _searched(segments: SegmentModel, seed: int, progress: Step | None) -> Mapping[str, Tensor]:
    """Returns the parameters that a search of the whole prior finds."""
    iterations = PRIOR_SEARCH.iterations_before_steps

    def search() -> dict[str, Tensor]:
        return {"z": search_prior(segments, iterations=iterations, seed=seed, progress=progress)}

    z = made_or_read(search, segments, "search", iterations, seed)["z"]
    found = segments.prior.to_parameters(z[None])
    return {name: value[0] for name, value in found.items()}


def _in_finer_steps(segments: SegmentModel) -> SegmentModel | None:
    """Returns a model in its next finer steps, ``None`` if it has none."""
    if segments.simulator.with_finer_steps() is None:
        return None
    return segments.with_model(with_finer_steps(segments.model))


def is_clearly_likelier(one: Hypothesis, other: Hypothesis) -> bool:
    """Returns whether the recording is clearly likelier with one of two hypotheses."""
    return weigh([one, other], [0.0, 0.0])[0] > BASE_FIT.clear_probability


def _distance(current: Hypothesis, difference: Tensor) -> float:
    """Returns the size of a difference of readings, in standard deviations of the residuals.

    Correlated residuals count as the fewer independent ones that they are worth. No parameter can
    then be off by more of its own standard deviations.

    Args:
        current: A hypothesis.
        difference: The difference between two simulations, ``(1, S, K, C)``.
    """
    whitened = current.segments.whitened(difference[0], current.fit.scale)
    return math.sqrt(current.share) * float(whitened.norm().nan_to_num(math.inf))
