"""Embedding networks trained jointly with a density estimator."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from npdr_ppl.errors import BackendError

__all__ = ["build_embedding"]


def build_embedding(
    build: Callable[[], nn.Module] | None, observation: Tensor
) -> tuple[nn.Module | None, int]:
    """Builds an untrained embedding network, if there is one.

    Args:
        build: Function that makes it, or ``None``.
        observation: An observation, ``(F,)`` or of the shape the network takes.

    Returns:
        The network, and the number of features that it returns; without a network, the number of
        features of the observation.

    Raises:
        BackendError: The network does not map a batch to ``(n, features)``.
    """
    if build is None:
        return None, observation.numel()
    embedding = build()
    with torch.no_grad():
        embedded = embedding.to(observation.device)(observation.expand(2, *observation.shape))
    if embedded.ndim != 2 or len(embedded) != 2:
        raise BackendError(
            "The embedding network must map a batch of arrays to (batch, features); two "
            f"arrays of shape {tuple(observation.shape)} gave {tuple(embedded.shape)}."
        )
    return embedding, embedded.shape[1]
