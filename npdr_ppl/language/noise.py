"""Measurement noise, which gives a deterministic simulator a density."""

from collections.abc import Callable, Mapping

import pyro.distributions as dist
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor

from npdr_ppl.errors import ModelError

__all__ = ["Noise", "noise_batch_shape", "reading_distribution"]

Noise = float | Tensor | Mapping[str, float | Tensor] | Callable[[Tensor], TorchDistribution]
"""Measurement noise: one standard deviation for all channels (a number, or a tensor of the batch
shape), one per channel by name, or a function from noise-free measurements to a distribution."""


def noise_batch_shape(noise: Noise | None) -> torch.Size:
    """Returns the batch shape of the noise's own parameters."""
    if isinstance(noise, Tensor):
        return noise.shape
    if isinstance(noise, Mapping):
        shapes = [torch.as_tensor(scale).shape for scale in noise.values()]
        return torch.broadcast_shapes(*shapes)
    return torch.Size()


def reading_distribution(
    noise: Noise, readings: Tensor, event_dim: int, channel_names: tuple[str, ...] | None
) -> TorchDistribution:
    """Returns the distribution of noisy measurements, independent over the event dimensions.

    Args:
        noise: See :data:`Noise`.
        readings: Noise-free measurements, batch shape plus ``event_dim`` dimensions; the last one
            is the channels.
        event_dim: Number of event dimensions.
        channel_names: Names of the channels, ``None`` for a plain function's output.

    Raises:
        ModelError: The noise names other channels than the measurements have.
    """
    if isinstance(noise, Mapping):
        if channel_names is None or set(noise) != set(channel_names):
            raise ModelError(
                f"noise names the channels {', '.join(sorted(noise))}, but the measurements are "
                f"{', '.join(channel_names or ('unnamed',))}."
            )
        columns = [torch.as_tensor(noise[name]).to(readings) for name in channel_names]
        scale = torch.stack(torch.broadcast_tensors(*columns), dim=-1)
        scale = scale.reshape(scale.shape[:-1] + (1,) * (event_dim - 1) + scale.shape[-1:])
        return dist.Normal(readings, scale, validate_args=False)  # NaN marks a failure
    if callable(noise):
        return noise(readings)
    scale = torch.as_tensor(noise).to(readings)
    scale = scale.reshape(scale.shape + (1,) * event_dim)
    return dist.Normal(readings, scale, validate_args=False)
