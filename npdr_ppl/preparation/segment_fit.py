"""Least-squares fits of parameters and of the segments' initial states to a recording.

The state at a segment's start is only known within the smoother's error, and an unstable motion
multiplies that error until it drowns what the parameters do. Here both are fitted: parameters z
in the prior's reference coordinates, shared by all segments, and for each segment the offset δ of
its initial state in standard deviations of the smoother's error. With whitened residuals r, what
is minimised is

    Σ_s |r_s(z, δ_s)|² + |δ_s|² + |z|²

by damped Gauss-Newton steps (Levenberg 1944) whose linear systems are reduced to the parameters
segment by segment. Each parameter is damped by its own curvature (Marquardt 1963): damped alike, a
Furuta pendulum's lengths, which are known a thousand times better than its masses, held those up
until steps ran out.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.preparation.segment_model import Linearisation, SegmentModel
from npdr_ppl.preparation.solving import solve_or_zero

__all__ = ["SegmentFit", "fit_segments"]

FIRST_DAMPING = 1e-2
LIMITS = 1e-8, 1e6
"""Of the parameters relative to their curvatures, and of each segment's initial state."""

NEAR = 0.1, 1.0, 10.0
"""Multiples of the last good dampings that are tried next."""

FAR = 1e-4, 1e-2, 1.0, 1e2, 1e4
"""Tried before it is said that nothing is left to gain."""

ROUGHLY = 1e-3
"""Share of the objective below which rough steps end …"""

SETTLED = 0.95
"""… once each channel's scale is at least so much of what it was."""

LARGEST_STEP = 1.0
"""Greatest change of a parameter's coordinate in one step, in standard deviations. Initial states
need no such limit: segments on an unstable motion are off by many, and each is damped apart."""

MAX_COORDINATE = 5.0
"""How far from the prior's centre a fit may lie, in standard deviations. A strength that is much
smaller than its half-normal prior expects lies at −3 and beyond."""

LEAST_GAIN = 0.5
"""Reduction of the objective, in units of the readings' variance, below which steps end: a quarter
of a unit of log evidence, a tenth of what makes one of two models ten times as likely."""

STANDS_OUT = 10.0
"""Multiple of the middle segment's misfit from which other initial states are tried …"""

ELSEWHERE = 1.0, 4.0
"""… so far away, in standard deviations of the smoother's error, along each component."""

LEAPS = 1.0, 3.0, 10.0
"""How far from a fit a better one is looked for where parts hit each other, in standard deviations
of what the fit leaves open …"""

WIDE_LEAPS = 0.03, 0.1, 0.3
"""… and in those of the priors, since a dent in the misfit says little of what is beyond it …"""

DIRECTIONS = 6
"""… in so many directions for each coordinate that leaps …"""

MOST_LEAPS = 4
"""… so many times at most."""


@dataclass(frozen=True)
class SegmentFit:
    """What a fit came to.

    Attributes:
        z: Parameters in reference coordinates, ``(d,)``.
        offsets: Offsets of the initial states, in standard deviations of the smoother's error,
            ``(S, m)``.
        scale: Root-mean-square residual per channel, in its unit, ``(C,)``.
    """

    z: Tensor
    offsets: Tensor
    scale: Tensor


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
    """Fits parameters and initial states, and finds the scale of what is left.

    The scale is part of the problem: it weighs the channels against each other and the recording
    against prior and smoother. It is that of the residuals after every step, until it changes
    little; the last steps are at one scale.

    Args:
        segments: The model and the recording.
        z: Where to begin, ``(d,)``.
        offsets: Offsets of the initial states to begin with, ``(S, m)``; zero by default.
        held: Coordinates that stay where they are, a mask ``(d,)``; none by default.
        scale: Standard deviation of each channel's errors, ``(C,)``, where that is known; that of
            the fit's residuals by default.
        max_steps: Greatest number of steps, first until the scale is known, then at that scale.
        is_rough: Whether the first will do; enough to rank what differs much.

    Raises:
        DataError: The simulation fails where the search begins.
    """
    z = z.double()
    if offsets is None:
        shape = segments.inputs.num_segments, segments.num_offsets
        offsets = torch.zeros(shape, dtype=torch.float64)
    present = segments.scale_of(z, offsets)
    if not bool(present.isfinite().all()):
        raise DataError("The simulation fails at the parameters that the fit begins with.")
    held = torch.zeros(z.shape, dtype=torch.bool) if held is None else held
    if scale is not None:
        known = scale.double()
        z, offsets, _ = _steps(segments, z, offsets, known, held, max_steps, is_rough=False)
        return SegmentFit(z, offsets, known)
    z, offsets, left = _steps(segments, z, offsets, present, held, max_steps, is_rough=True)
    if not is_rough:
        z, offsets, left = _steps(segments, z, offsets, left, held, max_steps, is_rough=False)
        freed = _freed(segments, z, offsets, left)
        if freed is not None:
            z, offsets, left = _steps(segments, z, freed, left, held, max_steps, is_rough=False)
        for _ in range(MOST_LEAPS):
            better = _leap(segments, z, offsets, left, held)
            if better is None:
                break
            z, offsets, left = _steps(segments, *better, left, held, max_steps, is_rough=False)
    return SegmentFit(z, offsets, left)


def _freed(segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor) -> Tensor | None:
    """Returns offsets from which segments that are stuck can go on; ``None`` if none is.

    Where friction holds, nothing depends on the rate that a segment starts with, and no step leads
    away from it. Left there, the segment would look as if a force had acted in it alone.

    Args:
        segments: The model and the recording.
        z: Parameters, ``(d,)``.
        offsets: Offsets of the initial states, ``(S, m)``.
        scale: Standard deviation of each channel's residuals, ``(C,)``.
    """
    if not segments.num_offsets:
        return None
    misfit = _squares(segments, z[None], offsets[None, None], scale)[0, 0].sum(-1)
    stands_out = misfit > STANDS_OUT * misfit.median()
    if not bool(stands_out.any()):
        return None
    axes = torch.eye(segments.num_offsets, dtype=torch.float64)
    moves = torch.cat([sign * far * axes for far in ELSEWHERE for sign in (1.0, -1.0)])
    tried = offsets + moves[:, None]  # (b, S, m)
    losses = _squares(segments, z[None], tried[None], scale)[0].sum(-1) + tried.square().sum(-1)
    least, chosen = losses.nan_to_num(torch.inf).min(0)
    is_stuck = stands_out & (least < misfit + offsets.square().sum(-1) - LEAST_GAIN)
    if not bool(is_stuck.any()):
        return None
    best = tried[chosen, torch.arange(len(offsets))]
    return torch.where(is_stuck[:, None], best, offsets)


def _leap(
    segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor, held: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Returns parameters and offsets that are better than a fit; ``None`` if none is found.

    Slopes lead to the nearest dent of the misfit. The parameters along which it has dents leap,
    and all others follow along the parabola about the fit; of the offsets each segment's follow or
    stay, whichever is better.

    Args:
        segments: The model and the recording.
        z: Parameters, ``(d,)``.
        offsets: Offsets of the initial states, ``(S, m)``.
        scale: Standard deviation of each channel's residuals, ``(C,)``.
        held: Coordinates that stay, a mask ``(d,)``.
    """
    leaping = segments.dented_coordinates & ~held
    num = int(leaping.sum())
    if not num:
        return None
    now = segments.linearise(z, offsets, scale)
    if not now.is_finite:
        return None
    now = replace(now, by_parameters=now.by_parameters * ~held)
    eye = torch.eye(len(z), dtype=torch.float64)
    covariance, is_solved = solve_or_zero(now.information() + eye, eye)
    spread, info = torch.linalg.cholesky_ex(covariance[leaping][:, leaping])
    if not bool(is_solved) or bool(info):
        return None
    following = torch.linalg.solve_triangular(spread, covariance[leaping], upper=False)
    generator = torch.Generator().manual_seed(0)
    shape = DIRECTIONS * num, num
    directions = torch.randn(shape, generator=generator, dtype=torch.float64)
    wide = torch.linalg.solve_triangular(spread, directions.T, upper=False).T
    leaps = torch.cat([f * directions for f in LEAPS] + [f * wide for f in WIDE_LEAPS])
    tried = (z + (leaps @ following) * ~held).clamp(-MAX_COORDINATE, MAX_COORDINATE)
    followed = offsets - torch.einsum("smd,nd->nsm", now.taken_back(), tried - z)
    begun = torch.stack((followed, offsets.expand_as(followed)), 1)  # (n, 2, S, m)
    squares = _squares(segments, tried, begun, scale)
    losses = (squares.sum(-1) + begun.square().sum(-1)).nan_to_num(torch.inf)
    least, chosen = losses.min(1)  # (n, S)
    outcome = least.sum(-1) + tried.square().sum(-1)
    best = int(outcome.argmin())
    present = sum(float(part.square().sum()) for part in (now.residual, offsets, z))
    if float(outcome[best]) > present - LEAST_GAIN:
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
) -> tuple[Tensor, Tensor, Tensor]:
    """Takes steps until they gain little.

    Rough steps make do with one-sided differences, and take the scale of what is left after each.
    Each segment has its own damping, because one that sticks, or slips when its neighbours stick,
    must not hold up the others: of the offsets tried at the same parameters every segment keeps
    its best.

    Args:
        segments: The model and the recording.
        z: Where to begin, ``(d,)``.
        offsets: Offsets of the initial states to begin with, ``(S, m)``.
        scale: Scale of what is left there, ``(C,)``.
        held: Coordinates that stay, a mask ``(d,)``.
        max_steps: Greatest number of steps.
        is_rough: Whether steps are rough.

    Returns:
        Parameters, offsets and the scale of what is left.
    """
    damping, dampings = FIRST_DAMPING, torch.full((len(offsets),), FIRST_DAMPING).double()
    factors, present_scale = NEAR, scale
    for _ in range(max_steps):
        now = segments.linearise(z, offsets, scale, is_rough=is_rough)
        now = replace(now, by_parameters=now.by_parameters * ~held)
        if not now.is_finite:
            break
        present = sum(float(part.square().sum()) for part in (now.residual, offsets, z))
        moves = [_step(now, z, offsets, held, damping * f, dampings, factors) for f in factors]
        tried = torch.stack([point for point, _ in moves])
        begun = torch.stack([starts for _, starts in moves])  # (a, b, S, m)
        squares = _squares(segments, tried, begun, scale)  # (a, b, S, C)
        losses = (squares.sum(-1) + begun.square().sum(-1)).nan_to_num(torch.inf)
        least, chosen = losses.min(1)  # (a, S)
        outcome = least.sum(-1) + tried.square().sum(-1)
        best = int(outcome.argmin())
        gain = present - float(outcome[best])
        is_little = gain < max(LEAST_GAIN, ROUGHLY * present if is_rough else 0.0)
        if gain > 0.0:
            place, every = chosen[best], torch.arange(len(offsets))
            z, offsets = tried[best], begun[best][place, every]
            damping = min(max(damping * factors[best], LIMITS[0]), LIMITS[1])
            dampings = (dampings * torch.tensor(factors).double()[place]).clamp(*LIMITS)
            left = squares[best][place, every].sum(0) / segments.inputs.mask.sum()
            present_scale = (scale * left.sqrt()).maximum(segments.least_scale)
            if is_rough:
                before, scale = scale, present_scale
                is_little = is_little and bool((scale > SETTLED * before).all())
        if not is_little:
            factors = NEAR
        elif factors == FAR or (is_rough and gain > 0.0):
            break
        else:
            factors = FAR
    return z, offsets, present_scale


def _squares(segments: SegmentModel, z: Tensor, offsets: Tensor, scale: Tensor) -> Tensor:
    """Returns the sums of squared whitened residuals, ``(a, b, S, C)``.

    Args:
        segments: The model and the recording.
        z: Parameters, ``(a, d)``.
        offsets: For each of them, b sets of offsets, ``(a, b, S, m)``.
        scale: Standard deviation of each channel's residuals, ``(C,)``.
    """
    a, b = offsets.shape[:2]
    residual = segments.residuals(z.repeat_interleave(b, 0), offsets.flatten(0, 1), scale)
    return residual.square().unflatten(-1, (-1, len(scale))).sum(-2).unflatten(0, (a, b))


def _step(
    now: Linearisation,
    z: Tensor,
    offsets: Tensor,
    held: Tensor,
    damping: float,
    dampings: Tensor,
    factors: tuple[float, ...],
) -> tuple[Tensor, Tensor]:
    """Returns parameters after one damped Gauss-Newton step, and offsets to try with them.

    A segment whose own system cannot be solved keeps its offsets, and the others are stepped as if
    they were known. Where the parameters' system cannot be solved, the parameters stay.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        offsets: Offsets, ``(S, m)``.
        held: Coordinates that stay, a mask ``(d,)``; nothing depends on them.
        damping: Of the parameters, relative to their curvatures.
        dampings: Of the offsets, by segment, ``(S,)``.
        factors: Multiples of ``dampings`` to try, among them 1.

    Returns:
        Parameters ``(d,)``, and offsets for each factor, ``(b, S, m)``.
    """
    by_z, by_start = now.by_parameters, now.by_starts
    d, m = by_z.shape[-1], by_start.shape[-1]
    own = by_start.mT @ by_start  # (S, m, m)
    pull = (by_start.mT @ now.residual[..., None])[..., 0] - offsets
    cross = by_start.mT @ by_z  # (S, m, d)
    sides = torch.cat((cross, pull[..., None]), dim=-1)
    eye = torch.eye(m, dtype=torch.float64)

    # Each segment's offsets are eliminated: they meet no other segment's readings.
    parts = {
        f: solve_or_zero(own + (1.0 + f * dampings)[:, None, None] * eye, sides)[0]
        for f in factors
    }
    middle = parts[1.0]
    hessian = (by_z.mT @ by_z - cross.mT @ middle[..., :d]).sum(0)
    gradient = (by_z.mT @ now.residual[..., None] - cross.mT @ middle[..., d:]).sum(0)[:, 0] - z
    curvature = hessian.diagonal().clamp_min(1.0)
    hessian = hessian + torch.diag(1.0 + damping * curvature)
    change = solve_or_zero(hessian, gradient.masked_fill(held, 0.0)[:, None])[0][:, 0]
    change = change * min(1.0, LARGEST_STEP / float(change.abs().max().clamp_min(1e-12)))
    moved = (z + change).clamp(-MAX_COORDINATE, MAX_COORDINATE)
    begun = [offsets + part[..., d] - part[..., :d] @ (moved - z) for part in parts.values()]
    return moved, torch.stack(begun)
