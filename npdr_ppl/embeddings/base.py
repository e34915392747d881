"""The protocol of an embedding: it maps trajectories to the features given to a backend."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from npdr_ppl.errors import ShapeError
from npdr_ppl.language.inputs import Inputs

__all__ = ["Embedding", "check_trajectory", "states_of"]


class Embedding(ABC):
    """Maps trajectories to features x, f_ψ of Muratore et al. (2021).

    Callers pass simulations chunk by chunk and keep only the features, so that memory does not
    grow with simulations × steps. Embeddings are immutable. A trained embedding provides a network
    that the backend trains jointly with its density estimator.

    Attributes:
        is_trained: Whether :meth:`network` has to be trained on the features.
    """

    is_trained: bool = False

    @abstractmethod
    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Maps trajectories to features.

        Args:
            trajectory: Measurements after each step, ``(B, S, K, C)``; the channels are those of
                the inputs, in the same order.
            inputs: The simulated segments: S segments of K steps.

        Returns:
            ``(B, F)``, or an array per simulation for a network. Padded steps have no influence.

        Raises:
            ShapeError: The trajectory does not fit the inputs.
        """

    def network(self, feature_shape: torch.Size) -> nn.Module | None:
        """Returns an untrained network for features; ``None`` if no network is needed.

        Args:
            feature_shape: Shape of one simulation's features; the network gets batches of them,
                standardised.
        """
        return None


def check_trajectory(trajectory: Tensor, inputs: Inputs) -> None:
    """Raises a ShapeError unless a trajectory ``(B, S, K, C)`` fits the inputs."""
    wanted = (inputs.num_segments, inputs.num_steps, len(inputs.channel_names))
    if trajectory.ndim != 4 or tuple(trajectory.shape[1:]) != wanted:
        raise ShapeError(
            f"an embedding of these inputs takes (B, {', '.join(map(str, wanted))}), got "
            f"{tuple(trajectory.shape)}."
        )


def states_of(trajectory: Tensor, inputs: Inputs) -> Tensor:
    """Returns each segment's measurements including the initial one, ``(B, S, K + 1, C)``."""
    check_trajectory(trajectory, inputs)
    start = inputs.initial_readings.to(trajectory)[..., None, :]
    return torch.cat([start.expand(len(trajectory), -1, -1, -1), trajectory], dim=2)
