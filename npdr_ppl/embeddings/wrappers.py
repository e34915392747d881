"""Embeddings of a reduced trajectory: every k-th step, block means, selected channels or steps."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from npdr_ppl.embeddings.base import Embedding, check_trajectory
from npdr_ppl.errors import DataError, ModelError, ShapeError
from npdr_ppl.language.inputs import Inputs

__all__ = ["Averaged", "Masked", "Strided"]


@dataclass(frozen=True)
class _Wrapper(Embedding):
    """Passes a reduced trajectory to another embedding, ``inner``."""

    inner: Embedding

    @property
    def is_trained(self) -> bool:  # type: ignore[override]
        """Whether the inner embedding is trained."""
        return self.inner.is_trained

    def network(self, feature_shape: torch.Size) -> nn.Module | None:
        """Returns the inner embedding's network."""
        return self.inner.network(feature_shape)


@dataclass(frozen=True)
class Strided(_Wrapper):
    """Passes every k-th measurement to another embedding.

    Measurements after steps k, 2k, … of a segment are kept, each with the action of the first of
    its k steps. If k does not divide the number of steps, the remaining steps are dropped.

    Attributes:
        inner: The embedding that gets the thinned trajectory.
        stride: k.
    """

    stride: int

    def __post_init__(self) -> None:
        """Checks the stride."""
        if self.stride < 1:
            raise ModelError(f"a stride is at least 1, got {self.stride}.")

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the inner embedding's features of the thinned trajectory."""
        check_trajectory(trajectory, inputs)
        k = self.stride
        mask = inputs.mask[:, k - 1 :: k]
        num_steps = mask.shape[1]
        if not bool(mask.any()):
            raise ShapeError(
                f"a stride of {k} leaves nothing of segments of {inputs.num_steps} steps."
            )
        thinned = replace(
            inputs,
            actions=inputs.actions[..., ::k, :][..., :num_steps, :],
            mask=mask,
            time_step=inputs.time_step * k,
            is_read=None,
            lateness=None,
        )
        return self.inner.features(trajectory[:, :, k - 1 :: k], thinned)


@dataclass(frozen=True)
class Averaged(_Wrapper):
    """Passes the means of blocks of k measurements to another embedding.

    If the measurements are noisy and the motion hardly changes within k steps, the means use every
    measurement, whereas :class:`Strided` discards most of them. The size is reduced by the same
    factor k. Measurements after steps 1 … k, k + 1 … 2k, … of a segment are averaged, and so are
    the actions of these steps. In a partly padded block only the steps that exist are averaged.

    Attributes:
        inner: The embedding that gets the averaged trajectory.
        block: k.
    """

    block: int

    def __post_init__(self) -> None:
        """Checks the block's length."""
        if self.block < 1:
            raise ModelError(f"a block has at least one step, got {self.block}.")

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the inner embedding's features of the averaged trajectory."""
        check_trajectory(trajectory, inputs)
        mask = inputs.mask.to(trajectory.device)
        averaged = replace(
            inputs,
            actions=self._means(inputs.actions, inputs.mask),
            mask=self._blocks(inputs.mask[..., None])[..., 0].any(-1),
            time_step=inputs.time_step * self.block,
            is_read=None,
            lateness=None,
        )
        return self.inner.features(self._means(trajectory, mask), averaged)

    def _means(self, values: Tensor, mask: Tensor) -> Tensor:
        """Averages ``(..., S, K, C)`` over blocks of the steps that exist."""
        counted = self._blocks(mask[..., None]).to(values)
        total = self._blocks(torch.where(mask[..., None], values, 0.0)).sum(-2)
        return total / counted.sum(-2).clamp(min=1)

    def _blocks(self, values: Tensor) -> Tensor:
        """Splits ``(..., K, C)`` into ``(..., blocks, k, C)``, zero-padded."""
        missing = -values.shape[-2] % self.block
        padded = nn.functional.pad(values, (0, 0, 0, missing))
        return padded.unflatten(-2, (-1, self.block))


@dataclass(frozen=True)
class Masked(_Wrapper):
    """Passes selected channels and steps to another embedding.

    Attributes:
        inner: The embedding that gets the selection.
        channels: Names and order of the channels kept, ``None`` for all.
        first_step: First step of each segment that is used, from 0.
        last_step: First step that is not used any more; ``None`` to use all up to the segment's
            end.
    """

    channels: tuple[str, ...] | None = None
    first_step: int = 0
    last_step: int | None = None

    def __post_init__(self) -> None:
        """Checks the choice."""
        if self.channels is not None and not self.channels:
            raise ModelError("no channel was chosen.")
        if self.first_step < 0 or (
            self.last_step is not None and self.last_step <= self.first_step
        ):
            raise ModelError(
                f"steps are chosen as 0 <= first < last, got {self.first_step} and "
                f"{self.last_step}."
            )

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the inner embedding's features of the selection."""
        check_trajectory(trajectory, inputs)
        if self.channels is not None:
            missing = [name for name in self.channels if name not in inputs.channel_names]
            if missing:
                raise DataError(
                    f"there is no channel {', '.join(missing)} to embed; there are "
                    f"{', '.join(inputs.channel_names)}."
                )
            trajectory = trajectory[..., [inputs.channel_names.index(c) for c in self.channels]]
            inputs = inputs.select_channels(self.channels)
        steps = torch.arange(inputs.num_steps, device=inputs.mask.device)
        kept = steps >= self.first_step
        if self.last_step is not None:
            kept &= steps < self.last_step
        mask = inputs.mask & kept
        if not bool(mask.any()):
            raise ShapeError(
                f"no segment has steps from {self.first_step} on; they have {inputs.num_steps}."
            )
        return self.inner.features(trajectory, replace(inputs, mask=mask))
