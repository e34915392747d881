"""Log densities of all members of an ensemble of flows in one pass, for training.

The members' weights are stacked, ``(members, out, in)``, and a layer of all members is one batched
matrix product. Rows are always the last dimension, ``(members, units, n)``, so that elementwise
operations on a spline's few bins run over rows. Values are those of the networks; only the order
of the arithmetic differs.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from zuko.transforms import MonotonicAffineTransform

from npdr_ppl.inference.parts.flows.flows import FlowNetwork, Spline
from npdr_ppl.inference.parts.training.ensemble_training import LogProb

__all__ = ["stacked_log_prob"]

BOUND, SLOPE = 5.0, 1e-3
"""Edge of a spline's interval and minimum slope, as in
:class:`~npdr_ppl.inference.parts.flows.flows.Spline` and zuko's affine map."""

LIMIT = -math.log(SLOPE)


def stacked_log_prob(
    network: nn.Module, parameters: Mapping[str, Tensor], buffers: Mapping[str, Tensor]
) -> LogProb:
    """Returns the log densities of all members as one call.

    Args:
        network: One of the members, a flow without an embedding network; its weights are not used.
        parameters: All members' parameters by name, each ``(members, ...)``.
        buffers: Their buffers.
    """
    assert isinstance(network, FlowNetwork) and network.embedding is None
    transforms: list[Any] = list(network.transform.transforms)
    layers = [
        [
            f"transform.transforms.{k}.hyper.{i}."
            for i in range(len(transform.hyper))
            if f"transform.transforms.{k}.hyper.{i}.weight" in parameters
        ]
        for k, transform in enumerate(transforms)
    ]

    known = {Spline, MonotonicAffineTransform}
    assert known >= {t.univariate for t in transforms}

    def log_prob(u: Tensor, f: Tensor) -> Tensor:
        shape = u.shape[:-1]
        # The atoms of a row share its context, which is computed once.
        atoms = u.shape[2] if u.ndim == 4 else 1
        x = u.flatten(1, -2).transpose(1, 2)
        context = f.flatten(2).transpose(1, 2)
        total = torch.zeros((), device=u.device)
        for transform, names in zip(transforms, layers, strict=True):
            outputs = _conditioner(names, parameters, buffers, x, context, atoms)
            outputs = outputs.unflatten(1, (x.shape[1], -1))
            if transform.univariate is Spline:
                x, log_slope = spline(outputs, x)
            else:
                x, log_slope = affine(outputs, x)
            total = total + log_slope
        density = total - 0.5 * (x**2 + math.log(2 * math.pi))
        return density.sum(1).view(shape)

    return log_prob


def _conditioner(
    names: list[str],
    parameters: Mapping[str, Tensor],
    buffers: Mapping[str, Tensor],
    x: Tensor,
    context: Tensor,
    atoms: int,
) -> Tensor:
    """Returns the outputs of a transform's conditioners, ``(members, outputs, n * atoms)``.

    Args:
        names: Prefixes of the layers' names.
        parameters: Parameters by name.
        buffers: Buffers by name.
        x: The transform's input, ``(members, d, n * atoms)``.
        context: Features, ``(members, F, n)``.
        atoms: Number of columns of x that share a context.
    """
    hidden = x
    for number, name in enumerate(names):
        weight, bias = parameters[name + "weight"], parameters[name + "bias"][..., None]
        if name + "mask" in buffers:
            weight = weight * buffers[name + "mask"]
        if number:
            hidden = torch.baddbmm(bias, weight, hidden.relu_())
            continue
        own = weight.shape[2] - context.shape[1]  # none with a single parameter
        hidden = torch.baddbmm(bias, weight[..., own:], context)
        if atoms > 1:
            hidden = hidden.repeat_interleave(atoms, dim=2)
        if own:
            hidden = torch.baddbmm(hidden, weight[..., :own], x)
    return hidden


def affine(outputs: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluates zuko's affine maps.

    Args:
        outputs: Shifts and unconstrained log scales, ``(members, d, 2, n)``.
        x: Arguments, ``(members, d, n)``.

    Returns:
        Values and log slopes, both ``(members, d, n)``.
    """
    shift, log_scale = outputs.unbind(2)
    log_scale = log_scale / (1 + log_scale.abs() / LIMIT)
    return x * log_scale.exp() + shift, log_scale


def spline(outputs: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluates monotonic rational-quadratic splines (Durkan et al. 2019, Eqs. 4 and 5).

    Args:
        outputs: Unconstrained widths and heights of K bins and derivatives at the inner knots,
            ``(members, d, 3 K - 1, n)``.
        x: Arguments, ``(members, d, n)``.

    Returns:
        Values and log slopes, both ``(members, d, n)``.
    """
    bins = (outputs.shape[2] + 1) // 3
    sizes, derivatives = outputs.split((2 * bins, bins - 1), dim=2)
    inside = x.abs() < BOUND
    argument = x.where(inside, 0.0)
    left, width, low, height, index = _SelectedBin.apply(
        sizes.unflatten(2, (2, bins)), argument.detach()
    )
    # Only the derivatives at the bin's ends are made positive; the outermost two are one.
    before = derivatives.gather(2, (index - 1).clamp(min=0)[:, :, None])[:, :, 0]
    after = derivatives.gather(2, index.clamp(max=bins - 2)[:, :, None])[:, :, 0]
    before, after = before.where(index > 0, 0.0), after.where(index < bins - 1, 0.0)
    d0 = (before / (1 + before.abs() / LIMIT)).exp()
    d1 = (after / (1 + after.abs() / LIMIT)).exp()
    slope = height / width
    z = (argument - left) / width
    mixed = z * (1 - z)
    denominator = slope + (d0 + d1 - 2 * slope) * mixed
    square = z * z
    value = low + height * (slope * square + d0 * mixed) / denominator
    numerator = 2 * slope * mixed + d0 * (1 - z) ** 2 + d1 * square
    log_slope = 2 * (slope / denominator).log() + numerator.log()
    return value.where(inside, x), log_slope.where(inside, 0.0)


class _SelectedBin(torch.autograd.Function):
    """The bin of an argument, with the derivatives of the values that depend on all bins."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        """Returns the bin's left edge, width, lower edge, height and index, in x's shape.

        Args:
            ctx: Stores the values that the gradient needs.
            raw: Unconstrained widths and heights, ``(members, d, 2, K, n)``.
            x: Arguments inside the interval, ``(members, d, n)``.
        """
        denominator = raw.abs().mul_(2 / LIMIT).add_(1)
        sizes = (raw / denominator).exp_()
        ends = sizes.cumsum(3)
        total = ends[:, :, :, -1]
        # Compared with unscaled knots, so that they need not be scaled.
        position = ((x + BOUND) * (1 / (2 * BOUND))) * total[:, :, 0]
        index = (ends[:, :, 0, :-1] < position[:, :, None]).sum(2)
        chosen = index[:, :, None, None].expand(-1, -1, 2, 1, -1)
        size = sizes.gather(3, chosen)[:, :, :, 0]
        start = ends.gather(3, chosen)[:, :, :, 0] - size
        scale = 2 * BOUND / total
        ctx.save_for_backward(sizes, denominator, index, size, start, total)
        edge, length = start * scale - BOUND, size * scale
        ctx.mark_non_differentiable(index)
        return edge[:, :, 0], length[:, :, 0], edge[:, :, 1], length[:, :, 1], index

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        """Returns the gradient of the unconstrained sizes."""
        sizes, denominator, index, size, start, total = ctx.saved_tensors
        edge = torch.stack((gradients[0], gradients[2]), 2)
        length = torch.stack((gradients[1], gradients[3]), 2)
        scale = 2 * BOUND / total
        mean = (edge * start + length * size) / total
        bins = torch.arange(sizes.shape[3], device=sizes.device)[:, None]
        number = index[:, :, None, None]
        whole = torch.where(bins < number, (edge - mean)[:, :, :, None], -mean[:, :, :, None])
        whole = torch.where(bins == number, (length - mean)[:, :, :, None], whole)
        slope = sizes / (denominator * denominator)
        return whole.mul_(slope).mul_(scale[:, :, :, None]), None
