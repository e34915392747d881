"""Least-squares fits of parameters and of the segments' initial states to a recording.

The state at a segment's start is only known within the smoother's error, and an unstable motion
multiplies that error until it is larger than the effect of the parameters. Both are therefore
fitted: parameters z in the prior's reference coordinates, shared by all segments, and for each
segment the offset δ of its initial state in standard deviations of the smoother's error. With
whitened residuals r, the fit minimises

    Σ_s |r_s(z, δ_s)|² + |δ_s|² + |z|²

by damped Gauss-Newton steps (Levenberg 1944). The offsets are eliminated segment by segment, so
that the remaining linear system has the size of the parameters. Each parameter is damped by its
own curvature (Marquardt 1963). With one damping for all parameters, the well-determined lengths
of a Furuta pendulum forced steps so small that its masses did not converge.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.preparation.gauss_newton import as_moved, possible_gain, step
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import SEGMENT_FIT
from npdr_ppl.preparation.solving import solve_or_zero

__all__ = ["SegmentFit", "fit_segments"]

MOST_KEPT = 1 << 23
"""Differences of trials that are kept until one is accepted, to bound memory: 64 MB."""

_Place = tuple[SegmentModel, Linearisation]
"""A model that is like the fitted one near a point, and its linearisation there."""


@dataclass(frozen=True)
class SegmentFit:
    """The result of a fit.

    Attributes:
        z: Parameters in reference coordinates, ``(d,)``.
        offsets: Offsets of the initial states, in standard deviations of the smoother's error,
            ``(S, m)``.
        scale: Root-mean-square residual per channel, in its unit, ``(C,)``.
        linearisation: Residuals and derivatives there, whitened by the scale; ``None`` if the fit
            ended without them.
        difference: Measurement minus simulation there, ``(S, K, C)``; ``None`` if the fit ended
            without it.
    """

    z: Tensor
    offsets: Tensor
    scale: Tensor
    linearisation: Linearisation | None = None
    difference: Tensor | None = None


def fit_segments(
    segments: SegmentModel,
    z: Tensor,
    *,
    offsets: Tensor | None = None,
    held: Tensor | None = None,
    scale: Tensor | None = None,
    max_steps: int = 12,
    is_rough: bool = False,
) -> SegmentFit:
    """Fits parameters and initial states, and finds the scale of the residuals.

    The scale weighs the channels against each other, and the recording against prior and
    smoother. After every step it is set to that of the residuals, until it changes little. The
    last steps use one scale.

    Args:
        segments: The model and the recording.
        z: First parameters, ``(d,)``.
        offsets: First offsets of the initial states, ``(S, m)``; zero by default.
        held: Mask of coordinates that are not fitted, ``(d,)``; none by default.
        scale: Standard deviation of each channel's errors, ``(C,)``, if known; that of the fit's
            residuals by default.
        max_steps: Greatest number of linearisations until the scale is known, and again at that
            scale.
        is_rough: Whether to stop once the scale is known. This is enough to rank fits that differ
            much.

    Raises:
        DataError: The simulation fails at the first parameters.
    """
    z = z.double()
    if offsets is None:
        offsets = segments.no_offsets
    held = torch.zeros(z.shape, dtype=torch.bool) if held is None else held
    unit = torch.ones(len(segments.channel_names), dtype=torch.float64)
    begun = unit if scale is None else scale.double()
    model, now = segments.corrected(z, offsets, begun, is_rough=scale is None)
    if not bool(now.residual.isfinite().all()):
        raise DataError("The simulation fails at the parameters that the fit begins with.")
    first = model, now
    if scale is not None:
        end = _steps(segments, z, offsets, begun, held, max_steps, is_rough=False, first=first)
        return replace(end, scale=begun, linearisation=None)
    present = _scale(segments, _by_channel(now.residual, unit), unit)
    first = model, now.rescaled(unit / present)
    end = _steps(segments, z, offsets, present, held, max_steps, is_rough=True, first=first)
    if is_rough:
        return replace(end, linearisation=None)
    first = segments.corrected(end.z, end.offsets, end.scale)
    share = segments.effective_share(first[1].residual)

    precise = partial(
        _steps, segments, held=held, max_steps=max_steps, is_rough=False, share=share
    )
    end = precise(end.z, end.offsets, end.scale, first=first, difference=end.difference)
    unstuck = _unstuck_offsets(segments, end)
    if unstuck is not None:
        end = precise(end.z, unstuck, end.scale)
    for _ in range(SEGMENT_FIT.most_restarts):
        better = _restart(segments, end.z, end.offsets, end.scale, held)
        if better is None:
            break
        end = precise(*better, end.scale)
    return replace(end, linearisation=None) if bool(held.any()) else end


def _unstuck_offsets(segments: SegmentModel, end: SegmentFit) -> Tensor | None:
    """Returns offsets from which badly fitted segments can improve; ``None`` if there are none.

    Where dry friction holds a joint, the simulation does not depend on the segment's initial rate,
    and no gradient leads away from a wrong one. Such a segment would look as if an additional
    force had acted in it.

    Args:
        segments: The model and the recording.
        end: Where the fit has ended.
    """
    if not segments.num_offsets:
        return None
    z, offsets, scale, difference = end.z, end.offsets, end.scale, end.difference
    if difference is None:
        difference = segments.difference(z[None], offsets[None])[0]
    misfit = _sums_of_squares(segments, difference, scale).sum(-1)
    is_outlier = misfit > SEGMENT_FIT.outlier_misfit * misfit.median()
    if not bool(is_outlier.any()):
        return None
    axes = torch.eye(segments.num_offsets, dtype=torch.float64)
    moves = torch.cat(
        [sign * far * axes for far in SEGMENT_FIT.initial_state_restarts for sign in (1.0, -1.0)]
    )
    tried = offsets + moves[:, None]  # (b, S, m)
    losses = _squares(segments, z[None], tried[None], scale)[0].sum(-1) + tried.square().sum(-1)
    least, chosen = losses.nan_to_num(torch.inf).min(0)
    is_stuck = is_outlier & (least < misfit + offsets.square().sum(-1) - SEGMENT_FIT.least_gain)
    if not bool(is_stuck.any()):
        return None
    best = tried[chosen, torch.arange(len(offsets))]
    return torch.where(is_stuck[:, None], best, offsets)


def _restart(
    segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor, held: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Returns a better point at which to restart; ``None`` if none is found.

    Gradients lead to the nearest local minimum of the misfit. Parameters along which it has local
    minima are drawn at random distances. All others follow to the minimum of the quadratic
    approximation at the fit. The offsets of each segment follow or stay, whichever is better.

    Args:
        segments: The model and the recording.
        z: Parameters, ``(d,)``.
        offsets: Offsets of the initial states, ``(S, m)``.
        scale: Standard deviation of each channel's residuals, ``(C,)``.
        held: Mask of coordinates that are not fitted, ``(d,)``.
    """
    has_minima = segments.coordinates_with_minima & ~held
    num = int(has_minima.sum())
    if not num:
        return None
    now = segments.linearise(z, offsets, scale)
    if not now.is_finite:
        return None
    now = replace(now, by_parameters=now.by_parameters * ~held)
    eye = torch.eye(len(z), dtype=torch.float64)
    covariance, is_solved = solve_or_zero(now.information() + eye, eye)
    spread, info = torch.linalg.cholesky_ex(covariance[has_minima][:, has_minima])
    if not bool(is_solved) or bool(info):
        return None
    following = torch.linalg.solve_triangular(spread, covariance[has_minima], upper=False)
    generator = torch.Generator().manual_seed(0)
    shape = SEGMENT_FIT.restart_directions * num, num
    directions = torch.randn(shape, generator=generator, dtype=torch.float64)
    wide = torch.linalg.solve_triangular(spread, directions.T, upper=False).T
    restarts = torch.cat(
        [f * directions for f in SEGMENT_FIT.restart_distances]
        + [f * wide for f in SEGMENT_FIT.wide_restart_distances]
    )
    tried = (z + (restarts @ following) * ~held).clamp(
        -SEGMENT_FIT.largest_coordinate, SEGMENT_FIT.largest_coordinate
    )
    followed = offsets - torch.einsum("smd,nd->nsm", now.taken_back(), tried - z)
    begun = torch.stack((followed, offsets.expand_as(followed)), 1)  # (n, 2, S, m)
    squares = _squares(segments, tried, begun, scale)
    losses = (squares.sum(-1) + begun.square().sum(-1)).nan_to_num(torch.inf)
    least, chosen = losses.min(1)  # (n, S)
    outcome = least.sum(-1) + tried.square().sum(-1)
    best = int(outcome.argmin())
    present = sum(float(part.square().sum()) for part in (now.residual, offsets, z))
    if float(outcome[best]) > present - SEGMENT_FIT.least_gain:
        return None
    return tried[best], begun[best][chosen[best], torch.arange(len(offsets))]


def _steps(
    segments: SegmentModel,
    z: Tensor,
    offsets: Tensor,
    scale: Tensor,
    held: Tensor,
    max_steps: int,
    *,
    is_rough: bool,
    share: float = 1.0,
    first: _Place | None = None,
    difference: Tensor | None = None,
) -> SegmentFit:
    """Takes steps until they gain little.

    Where the simulator has coarser steps, each linearisation and the trials after it take those,
    with what they miss at its point (:meth:`SegmentModel.corrected`).

    Derivatives cost most of a step. So a few further steps use those of an earlier point,
    corrected by what the last step has changed (Broyden 1965). Where the misfit has local minima,
    corrected derivatives could lead into one, and steps end only after trials far away.

    Rough steps use one-sided differences and set the scale to that of the residuals after each
    step. Each segment has its own damping, because a segment in which a joint sticks would
    otherwise force small steps on all others. Of the offsets tried at the same parameters, every
    segment keeps its best.

    Args:
        segments: The model and the recording.
        z: First parameters, ``(d,)``.
        offsets: First offsets of the initial states, ``(S, m)``.
        scale: Scale of the residuals there, ``(C,)``.
        held: Mask of coordinates that are not fitted, ``(d,)``.
        max_steps: Greatest number of linearisations.
        is_rough: Whether steps are rough.
        share: Effective number of measurements as a share of all; the fewer, the less log evidence
            is in a gain.
        first: :meth:`SegmentModel.corrected` at the first point, if it is known.
        difference: Measurement minus simulation at the first point, if it is known.

    Returns:
        The end, whose scale is that of the residuals there.
    """
    damping, dampings = (
        SEGMENT_FIT.first_damping,
        torch.full((len(offsets),), SEGMENT_FIT.first_damping).double(),
    )
    factors, present_scale = SEGMENT_FIT.near_factors, scale
    has_minima = bool((segments.coordinates_with_minima & ~held).any())
    uniform = segments.prior.uniform_coordinates
    now, model, num_updates, num_linearised = None, segments, 0, 0
    known: tuple[Tensor, Tensor, Tensor, Linearisation] | None = None
    found: tuple[float, Tensor, Tensor, Tensor] | None = None
    most_updates = 0 if has_minima else _most_updates(segments, held, is_rough=is_rough)
    while True:
        if now is None:
            if num_linearised == max_steps:
                break
            model, now = first or segments.corrected(z, offsets, scale, is_rough=is_rough)
            first = None
            if model is not segments:
                # The squares of the last step had an earlier correction.
                present_scale = _scale(segments, _by_channel(now.residual, scale), scale)
            now = replace(now, by_parameters=now.by_parameters * ~held)
            known = z, offsets, scale, now
            num_updates, num_linearised = 0, num_linearised + 1
        if not now.is_finite:
            if not num_updates:
                break
            now = None
            continue
        present = sum(float(part.square().sum()) for part in (now.residual, offsets, z))
        enough = max(
            SEGMENT_FIT.least_gain / share, SEGMENT_FIT.rough_gain * present if is_rough else 0.0
        )
        if model is not segments and not is_rough and not num_updates:
            # Corrections differ from point to point: gains count from one to the next.
            if found is not None and present > found[0] - enough:
                if present > found[0]:
                    (_, z, offsets, present_scale), difference = found, None
                break
            found = present, z, offsets, present_scale
        if not has_minima and possible_gain(now, z, offsets, held, uniform) < enough:
            if not num_updates:
                break
            now = None
            continue
        moves = [
            step(now, z, offsets, held, damping * f, dampings, factors, uniform) for f in factors
        ]
        tried = torch.stack([point for point, _ in moves])
        begun = torch.stack([starts for _, starts in moves])  # (a, b, S, m)
        squares, differences = _tried(model, tried, begun, scale)  # (a, b, S, C)
        losses = (squares.sum(-1) + begun.square().sum(-1)).nan_to_num(torch.inf)
        least, chosen = losses.min(1)  # (a, S)
        outcome = least.sum(-1) + tried.square().sum(-1)
        best = int(outcome.argmin())
        gain = present - float(outcome[best])
        is_little = gain < enough
        place, every = chosen[best], torch.arange(len(offsets))
        at_best = None if differences is None else differences[best][place, every]
        del differences  # large for a long recording
        if gain > 0.0:
            last = z, offsets
            z, offsets = tried[best], begun[best][place, every]
            # In coarser steps it is only approximate.
            difference = at_best if model is segments else None
            damping = min(
                max(damping * factors[best], SEGMENT_FIT.damping_limits[0]),
                SEGMENT_FIT.damping_limits[1],
            )
            dampings = (dampings * torch.tensor(factors).double()[place]).clamp(
                *SEGMENT_FIT.damping_limits
            )
            present_scale = _scale(segments, squares[best][place, every].sum(0), scale)
            before = scale
            if is_rough:
                scale = present_scale
                is_little = is_little and bool((scale > SEGMENT_FIT.settled_scale * before).all())
            corrected = None
            if most_updates:
                if at_best is None:
                    at_best = model.difference(z[None], offsets[None])[0]
                followed, change = as_moved(now, last[0], z, uniform)
                corrected = followed.rescaled(before / scale).updated(
                    model.whitened(at_best, scale), change, offsets - last[1]
                )
            now = corrected
        if is_little and num_updates:
            # Only derivatives that are computed at this point can show that nothing is left.
            now, factors = None, SEGMENT_FIT.near_factors
            continue
        if not is_little:
            factors = SEGMENT_FIT.near_factors
        elif factors == SEGMENT_FIT.far_factors or (is_rough and gain > 0.0):
            break
        else:
            factors = SEGMENT_FIT.far_factors
            now = now if gain <= 0.0 else None
            continue
        num_updates += 1
        if num_updates > most_updates:
            now = None
    last = None
    if known is not None and known[0] is z and known[1] is offsets:
        last = known[3].rescaled(known[2] / present_scale)
    return SegmentFit(z, offsets, present_scale, last, difference)


def _by_channel(residual: Tensor, scale: Tensor) -> Tensor:
    """Returns the sums of squares of residuals ``(S, N)`` by channel, ``(C,)``."""
    return residual.square().unflatten(-1, (-1, len(scale))).sum((0, 1))


def _scale(segments: SegmentModel, square: Tensor, scale: Tensor) -> Tensor:
    """Returns the scale of residuals in their units from squares of whitened ones, ``(C,)``."""
    count = segments.num_measured.sum(0).clamp_min(1)
    return (scale * (square / count).sqrt()).maximum(segments.least_scale)


def _most_updates(segments: SegmentModel, held: Tensor, *, is_rough: bool) -> int:
    """Returns how many steps may use corrected derivatives, 0 if corrections save little.

    Args:
        segments: The model and the recording.
        held: Mask of coordinates that are not fitted, ``(d,)``.
        is_rough: Whether differences are one-sided.
    """
    sides = 1 if is_rough else 2
    derivatives = sides * (len(held) + segments.num_offsets)
    if derivatives < SEGMENT_FIT.least_ratio * len(SEGMENT_FIT.near_factors) ** 2:
        return 0
    return SEGMENT_FIT.most_updates


def _squares(segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor) -> Tensor:
    """Returns the sums of squared whitened residuals, ``(a, b, S, C)``.

    Args:
        segments: The model and the recording.
        z: Parameters, ``(a, d)``.
        offsets: For each of them, b sets of offsets, ``(a, b, S, m)``.
        scale: Standard deviation of each channel's residuals, ``(C,)``.
    """
    return torch.cat(
        [_sums_of_squares(segments, part, scale) for part in _in_chunks(segments, z, offsets)]
    ).unflatten(0, offsets.shape[:2])


def _tried(
    segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor | None]:
    """Returns :func:`_squares`, and measurements minus simulations, ``(a, b, S, K, C)``.

    The latter are ``None`` if there are more than :data:`MOST_KEPT`.
    """
    if offsets.shape[:2].numel() * segments.observed.numel() > MOST_KEPT:
        return _squares(segments, z, offsets, scale), None
    parts = [*_in_chunks(segments, z, offsets)]
    squares = torch.cat([_sums_of_squares(segments, part, scale) for part in parts])
    shape = offsets.shape[:2]
    return squares.unflatten(0, shape), torch.cat(parts).unflatten(0, shape)


def _in_chunks(segments: SegmentModel, z: Tensor, offsets: Tensor) -> Iterator[Tensor]:
    """Yields measurements minus simulations of some points at once, ``(n, S, K, C)``."""
    together = segments.draws_per_chunk
    points = z.repeat_interleave(offsets.shape[1], 0).split(together)
    for point, starts in zip(points, offsets.flatten(0, 1).split(together), strict=True):
        yield segments.difference(point, starts)


def _sums_of_squares(segments: SegmentModel, difference: Tensor, scale: Tensor) -> Tensor:
    """Returns the sums of squares of whitened differences ``(…, S, K, C)``, ``(…, S, C)``."""
    whitened = segments.whitened(difference, scale)
    return whitened.square().unflatten(-1, (-1, len(scale))).sum(-2)
