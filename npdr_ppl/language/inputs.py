"""What a simulator is told: actions, time step and how each segment starts."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from npdr_ppl.errors import ShapeError

__all__ = ["Inputs"]


@dataclass(frozen=True)
class Inputs:
    """Inputs of a batch of segments; sizes are S segments, K steps, A actions and C channels.

    A segment is a stretch of a rollout that is simulated from a re-synchronised state. All
    segments share K; where a segment is shorter, its tail is padded and ``mask`` is false there.
    Tensors may carry leading batch dimensions that broadcast against the parameters', e.g. for a
    plate of devices that were each given other actions.

    Attributes:
        actions: Commands, each held for one step, shape ``(..., S, K, A)``.
        action_names: Names of the A actions.
        initial_readings: What the sensors reported at each segment's start, ``(..., S, C)``.
        initial_values: Best value of each channel at the start: the reading itself (``recorded``)
            or a smoother's estimate (``estimated``), ``(..., S, C)``.
        initial_rates: Estimated time derivative of each channel at the start, in units per
            second, ``(..., S, C)``; ``None`` where recorded states are taken as true.
        channel_names: Names of the C channels.
        past_actions: Commands of the H steps before each segment, oldest first, zero before the
            rollout began, ``(..., S, H, A)``; delays need them.
        time_step: Seconds between actions.
        mask: True for steps that exist, ``(S, K)``.
        rollout: Index of the rollout that each segment comes from, ``(S,)``.
        start: Step of the rollout at which each segment starts, ``(S,)``.
    """

    actions: Tensor
    action_names: tuple[str, ...]
    initial_readings: Tensor
    initial_values: Tensor
    initial_rates: Tensor | None
    channel_names: tuple[str, ...]
    past_actions: Tensor
    time_step: float
    mask: Tensor
    rollout: Tensor
    start: Tensor

    def __post_init__(self) -> None:
        """Checks that the shapes fit each other."""
        segments, steps, num_actions = self.actions.shape[-3:]
        expected = {
            "mask": ((segments, steps), self.mask.shape),
            "rollout": ((segments,), self.rollout.shape),
            "start": ((segments,), self.start.shape),
            "actions": (len(self.action_names), num_actions),
            "initial_readings": (
                (segments, len(self.channel_names)),
                tuple(self.initial_readings.shape[-2:]),
            ),
            "initial_values": (
                (segments, len(self.channel_names)),
                tuple(self.initial_values.shape[-2:]),
            ),
            "past_actions": (
                (segments, num_actions),
                (self.past_actions.shape[-3], self.past_actions.shape[-1]),
            ),
        }
        for name, (want, got) in expected.items():
            if want != got and tuple(want) != tuple(got):
                raise ShapeError(f"Inputs.{name} should have shape {want}, got {got}.")

    @classmethod
    def single(
        cls,
        actions: Tensor,
        initial_state: Tensor,
        *,
        action_names: tuple[str, ...],
        state_names: tuple[str, ...],
        time_step: float,
        history: int = 0,
    ) -> "Inputs":
        """Returns one segment that starts in a known state, e.g. for an experiment to simulate.

        Args:
            actions: Commands, ``(K, A)``.
            initial_state: State at the start, ``(len(state_names),)``.
            action_names: Names of the actions.
            state_names: Names of the state's components.
            time_step: Seconds between actions.
            history: Steps of zero commands to assume before the start.
        """
        actions = torch.atleast_2d(actions)
        state = torch.as_tensor(initial_state, dtype=actions.dtype).expand(1, -1)
        return cls(
            actions=actions[None],
            action_names=action_names,
            initial_readings=state,
            initial_values=state,
            initial_rates=None,
            channel_names=state_names,
            past_actions=actions.new_zeros(1, history, actions.shape[-1]),
            time_step=time_step,
            mask=torch.ones(1, actions.shape[0], dtype=torch.bool),
            rollout=torch.zeros(1, dtype=torch.long),
            start=torch.zeros(1, dtype=torch.long),
        )

    @property
    def num_segments(self) -> int:
        """Number of segments S."""
        return self.actions.shape[-3]

    @property
    def num_steps(self) -> int:
        """Number of steps K of the longest segment."""
        return self.actions.shape[-2]

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions, empty unless devices were given different inputs."""
        return self.actions.shape[:-3]

    def to(
        self, *, dtype: torch.dtype | None = None, device: str | torch.device | None = None
    ) -> "Inputs":
        """Returns the inputs with tensors on ``device`` and floating ones as ``dtype``."""
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                kind = dtype if value.is_floating_point() else None
                changed[field.name] = value.to(device=device, dtype=kind)
        return replace(self, **changed)

    def segments(self, index: Tensor | slice | list[int]) -> "Inputs":
        """Returns the inputs of the chosen segments only."""
        rates = self.initial_rates
        return replace(
            self,
            actions=self.actions[..., index, :, :],
            initial_readings=self.initial_readings[..., index, :],
            initial_values=self.initial_values[..., index, :],
            initial_rates=None if rates is None else rates[..., index, :],
            past_actions=self.past_actions[..., index, :, :],
            mask=self.mask[index],
            rollout=self.rollout[index],
            start=self.start[index],
        )

    def select_channels(self, names: Sequence[str]) -> "Inputs":
        """Returns the inputs with only these channels, in this order."""
        columns = [self.channel_names.index(name) for name in names]
        rates = self.initial_rates
        return replace(
            self,
            initial_readings=self.initial_readings[..., columns],
            initial_values=self.initial_values[..., columns],
            initial_rates=None if rates is None else rates[..., columns],
            channel_names=tuple(names),
        )

    def element(self, index: int) -> "Inputs":
        """Returns the inputs of one element of the (flattened) batch; all share unbatched ones."""
        if not self.batch_shape:
            return self
        depth = len(self.batch_shape)
        changed = {}
        for name in (
            "actions",
            "past_actions",
            "initial_readings",
            "initial_values",
            "initial_rates",
        ):
            value = getattr(self, name)
            if value is not None:
                event = value.shape[depth:]
                changed[name] = value.expand(self.batch_shape + event).flatten(0, depth - 1)[index]
        return replace(self, **changed)
