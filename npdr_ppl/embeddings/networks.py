"""Embeddings that are trained: linear, recurrent and convolutional networks of trajectories."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from npdr_ppl.embeddings.base import Embedding, check_trajectory
from npdr_ppl.errors import ShapeError
from npdr_ppl.language.inputs import Inputs

__all__ = ["Convolutional", "Linear", "Recurrent"]


class _Trained(Embedding):
    """A raw trajectory as features, the input of a network."""

    is_trained = True

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the measurements, ``(B, S, K, C)``, zero where a step does not exist."""
        check_trajectory(trajectory, inputs)
        mask = inputs.mask.to(trajectory.device)
        return torch.where(mask[..., None], trajectory, 0.0)


@dataclass(frozen=True)
class Linear(_Trained):
    """One trained linear layer over all measurements of all segments.

    It suits trajectories in which every measurement has its own meaning, such as the path of a
    ball, and learns the relevant combinations. With a stride of 2, ``linear/2``, it is the
    embedding of Muratore et al. (2021) for mini golf.

    Attributes:
        output: Number of features F for the density estimator.
    """

    output: int = 100

    def network(self, feature_shape: torch.Size) -> nn.Module:
        """Returns the network ``(n, S, K, C) → (n, F)``."""
        _checked(feature_shape)
        return nn.Sequential(nn.Flatten(), nn.Linear(feature_shape.numel(), self.output))


@dataclass(frozen=True)
class Recurrent(_Trained):
    """A gated recurrent unit over the steps of each segment; segments are pooled.

    Thin long rollouts with a stride, e.g. ``gru/10``.

    Attributes:
        hidden: Units of the recurrent layer.
        output: Number of features F for the density estimator.

    References:
        K. Cho et al., Learning phrase representations using RNN encoder–decoder, 2014.
    """

    hidden: int = 48
    output: int = 24

    def network(self, feature_shape: torch.Size) -> nn.Module:
        """Returns the network ``(n, S, K, C) → (n, F)``."""
        segments, _, channels = _checked(feature_shape)
        return _Pooled(
            _RecurrentEncoder(channels, self.hidden), segments, self.hidden, self.output
        )


@dataclass(frozen=True)
class Convolutional(_Trained):
    """Three strided 1-D convolutions over the steps of each segment; segments are pooled.

    Attributes:
        hidden: Feature maps of the widest layer.
        output: Number of features F for the density estimator.
    """

    hidden: int = 48
    output: int = 24

    def network(self, feature_shape: torch.Size) -> nn.Module:
        """Returns the network ``(n, S, K, C) → (n, F)``."""
        segments, _, channels = _checked(feature_shape)
        encoder = _ConvolutionalEncoder(channels, self.hidden)
        return _Pooled(encoder, segments, self.hidden, self.output)


def _checked(feature_shape: torch.Size) -> tuple[int, int, int]:
    if len(feature_shape) != 3 or 0 in feature_shape:
        raise ShapeError(f"a network reads (segments, steps, channels), got {feature_shape}.")
    segments, steps, channels = feature_shape
    return segments, steps, channels


class _Pooled(nn.Module):
    """Encodes each segment separately, passes the codes through a small network and averages.

    Segments differ in their initial states and actions, which are the same in every simulation. A
    learnt code per segment identifies the segment to the network, so that averaging does not mix
    segments up.
    """

    def __init__(self, encoder: nn.Module, segments: int, hidden: int, output: int) -> None:
        super().__init__()
        # Any encoder's output has unit scale, so that the segments' codes are not negligible.
        self.encoder = nn.Sequential(encoder, nn.LayerNorm(hidden))
        self.segment_code = nn.Parameter(torch.randn(segments, hidden))
        self.mix = nn.Sequential(
            nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden)
        )
        self.head = nn.Sequential(nn.SiLU(), nn.Linear(hidden, output))

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``(n, S, K, C)`` to ``(n, F)``."""
        codes = self.encoder(x.flatten(0, 1)).unflatten(0, x.shape[:2])
        labelled = torch.cat([codes, self.segment_code.expand_as(codes)], dim=-1)
        return self.head(self.mix(labelled).mean(1))


class _RecurrentEncoder(nn.Module):
    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.gru = nn.GRU(channels, hidden, batch_first=True)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``(N, K, C)`` to ``(N, hidden)``."""
        _, last = self.gru(x)
        return last[0]


class _ConvolutionalEncoder(nn.Module):
    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        widths = (channels, max(hidden // 2, 1), hidden, hidden)
        layers: list[nn.Module] = []
        for before, after in zip(widths[:-1], widths[1:], strict=True):
            # Kernel 5 with padding 2 keeps at least one step of any segment.
            layers += [nn.Conv1d(before, after, 5, stride=2, padding=2), nn.SiLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``(N, K, C)`` to ``(N, hidden)``."""
        return self.layers(x.mT).mean(-1)
