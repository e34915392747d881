"""Inputs of a simulator: actions, time step and initial state of each segment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from npdr_ppl.errors import ShapeError

__all__ = ["Inputs"]

_STARTS = (
    "initial_readings",
    "initial_values",
    "initial_rates",
    "initial_value_errors",
    "initial_rate_errors",
)

_UNBATCHED = "is_read", "lateness", "is_zero"


@dataclass(frozen=True)
class Inputs:
    """Inputs of a batch of segments; sizes are S segments, K steps, A actions and C channels.

    A segment is a stretch of a rollout that is simulated from a re-synchronised state. All
    segments have K steps; a shorter segment is padded at its end, where ``mask`` is false.
    Tensors may have leading batch dimensions that broadcast against the parameters', e.g. for a
    plate of devices with different actions.

    Attributes:
        actions: Commands, each held for one step, shape ``(..., S, K, A)``.
        action_names: Names of the A actions.
        initial_readings: Measurements at each segment's start, ``(..., S, C)``.
        initial_values: Best value of each channel at the start, ``(..., S, C)``: the measurement
            itself (``recorded``) or a smoother's estimate (``estimated``).
        channel_names: Names of the C channels.
        past_actions: Commands of the H steps before each segment, oldest first, zero before the
            rollout began, ``(..., S, H, A)``; delays need them. See ``began_in_operation``.
        time_step: Seconds between actions.
        mask: True for steps that exist, ``(S, K)``.
        rollout: Index of the rollout that each segment comes from, ``(S,)``.
        start: Step of the rollout at which each segment starts, ``(S,)``.
        initial_rates: Estimated time derivative of each channel at the start, in units per
            second, ``(..., S, C)``; ``None`` if recorded states are assumed to be exact.
        initial_value_errors: Standard deviations of the initial values' errors, ``(..., S, C)``;
            ``None`` if the values are assumed to be exact. With errors, every simulation starts
            from a different draw.
        initial_rate_errors: Standard deviations of the initial rates' errors.
        is_read: Whether each channel was measured after each step, ``(S, K, C)``; ``None`` if all
            were, at the end of the step.
        lateness: Time from the end of the step to the measurement, in steps, ``(S, K, C)``.
        recorded_actions: Commands of whole rollouts, zero beyond their ends, ``(R, T, A)``; states
            that sum up the whole past, such as a servo's integral, need them. ``None`` if there is
            no recording, or if they would take more than 32 MiB.
        recorded_readings: Measurements before each step of whole rollouts, ``(R, T, C)``; forces
            and servos that depend on past motion need them. ``None`` likewise.
        is_zero: Whether the value, then the rate, of each channel is zero within two standard
            deviations of its error at the first sample of a rollout, ``(S, 2, C)``; false for
            other segments. ``None`` if the initial values say so exactly.
        began_in_operation: Whether the first commands of a rollout had been acting before it, as
            where a log was cut from a flight. Otherwise commands before it are zero. Servos held
            their first goals in any case.
    """

    actions: Tensor
    action_names: tuple[str, ...]
    initial_readings: Tensor
    initial_values: Tensor
    channel_names: tuple[str, ...]
    past_actions: Tensor
    time_step: float
    mask: Tensor
    rollout: Tensor
    start: Tensor
    initial_rates: Tensor | None = None
    initial_value_errors: Tensor | None = None
    initial_rate_errors: Tensor | None = None
    is_read: Tensor | None = None
    lateness: Tensor | None = None
    recorded_actions: Tensor | None = None
    recorded_readings: Tensor | None = None
    is_zero: Tensor | None = None
    began_in_operation: bool = False

    def __post_init__(self) -> None:
        """Checks that the shapes match."""
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
        for name, columns in (
            ("recorded_actions", self.action_names),
            ("recorded_readings", self.channel_names),
        ):
            value = getattr(self, name)
            if value is not None:
                expected[name] = ((*value.shape[:2], len(columns)), tuple(value.shape))
        if self.is_zero is not None:
            shape = (segments, 2, len(self.channel_names))
            expected["is_zero"] = (shape, tuple(self.is_zero.shape))
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
        """Returns one segment with a known initial state, e.g. to simulate an experiment.

        Args:
            actions: Commands, ``(K, A)``.
            initial_state: State at the start, ``(len(state_names),)``.
            action_names: Names of the actions.
            state_names: Names of the state's components.
            time_step: Seconds between actions.
            history: Number of steps with zero commands before the start.
        """
        actions = torch.atleast_2d(actions)
        state = torch.as_tensor(initial_state, dtype=actions.dtype).expand(1, -1)
        return cls(
            actions=actions[None],
            action_names=action_names,
            initial_readings=state,
            initial_values=state,
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
        """Leading dimensions; empty unless devices have different inputs."""
        return self.actions.shape[:-3]

    def commands(self, column: int, *, num_past: int, is_goal: bool) -> Tensor:
        """Returns the past and the present commands of one action, ``(..., S, num_past + K)``.

        Those before a rollout are its first one if it is the goal of a servo, or if the recording
        began in operation; otherwise they are zero.

        Args:
            column: Column of the action.
            num_past: Number of past steps, at most H.
            is_goal: Whether the action is the goal of a servo.
        """
        left_out = self.past_actions.shape[-2] - num_past
        past = self.past_actions[..., left_out:, column]
        every = torch.cat((past, self.actions[..., column]), dim=-1)
        if not (is_goal or self.began_in_operation):
            return every
        first = (num_past - self.start).clamp_min(0)[..., None]
        held = every.gather(-1, first.expand(*every.shape[:-1], 1))
        return torch.where(torch.arange(every.shape[-1], device=every.device) < first, held, every)

    @property
    def is_start_uncertain(self) -> bool:
        """Whether every simulation draws its own initial states."""
        return self.initial_value_errors is not None

    def with_drawn_start(self, batch_shape: torch.Size) -> "Inputs":
        """Returns the inputs with initial states drawn for every element of a batch.

        Args:
            batch_shape: Shape of the batch, to which the inputs' own batch shape broadcasts.
        """
        if self.initial_value_errors is None:
            return self

        def drawn(mean: Tensor | None, error: Tensor | None) -> Tensor | None:
            if mean is None or error is None:
                return mean
            shape = batch_shape + mean.shape[-2:]
            return mean + error * torch.randn(shape, dtype=mean.dtype, device=mean.device)

        values = drawn(self.initial_values, self.initial_value_errors)
        assert values is not None
        return replace(
            self,
            initial_values=values,
            initial_rates=drawn(self.initial_rates, self.initial_rate_errors),
            initial_value_errors=None,
            initial_rate_errors=None,
        )

    def to(
        self, *, dtype: torch.dtype | None = None, device: str | torch.device | None = None
    ) -> "Inputs":
        """Returns the inputs with tensors on ``device``; floating-point ones get ``dtype``."""
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                kind = dtype if value.is_floating_point() else None
                changed[field.name] = value.to(device=device, dtype=kind)
        return replace(self, **changed)

    def segments(self, index: Tensor | slice | list[int]) -> "Inputs":
        """Returns the inputs of the chosen segments only."""
        return replace(
            self,
            **self._starts(lambda value: value[..., index, :]),
            actions=self.actions[..., index, :, :],
            past_actions=self.past_actions[..., index, :, :],
            **self._unbatched(lambda value: value[index]),
            mask=self.mask[index],
            rollout=self.rollout[index],
            start=self.start[index],
        )

    def select_channels(self, names: Sequence[str]) -> "Inputs":
        """Returns the inputs with only these channels, in this order."""
        columns = [self.channel_names.index(name) for name in names]
        return replace(
            self,
            **self._starts(lambda value: value[..., columns]),
            **self._unbatched(lambda value: value[..., columns]),
            recorded_readings=None
            if self.recorded_readings is None
            else self.recorded_readings[..., columns],
            channel_names=tuple(names),
        )

    def earlier(self, name: str, steps: Tensor) -> Tensor | None:
        """Returns measurements of a channel before the segments, ``(M, S)``.

        Before its rollout began, a channel had the value of the first measurement. Beyond the
        longest rollout's end it has the last one.

        Args:
            name: The channel.
            steps: How many steps before the segments' starts, ``(M,)`` or ``(M, S)``; negative
                ones are after.

        Returns:
            ``None`` if they are unknown.
        """
        if self.recorded_readings is None or name not in self.channel_names:
            return None
        steps = steps.to(self.start.device).reshape(len(steps), -1)
        rows = (self.start - steps).clamp(0, self.recorded_readings.shape[1] - 1)
        return self.recorded_readings[self.rollout, rows, self.channel_names.index(name)]

    def element(self, index: int) -> "Inputs":
        """Returns the inputs of one element of the (flattened) batch; unbatched ones unchanged."""
        if not self.batch_shape:
            return self
        depth = len(self.batch_shape)

        def chosen(value: Tensor, num_own: int = 2) -> Tensor:
            event = value.shape[-num_own:]  # some values may be those of all elements
            return value.expand(self.batch_shape + event).flatten(0, depth - 1)[index]

        return replace(
            self,
            **self._starts(chosen),
            actions=chosen(self.actions, 3),
            past_actions=chosen(self.past_actions, 3),
        )

    def measured(self, names: Sequence[str]) -> Tensor:
        """Returns whether there is a measurement, ``(S, K, len(names))``, or ``(S, K, 1)``.

        Args:
            names: Names of channels; those that were not recorded count as measured.
        """
        if self.is_read is None:
            return self.mask[..., None]
        ones = torch.ones_like(self.mask)
        known = dict(zip(self.channel_names, self.is_read.unbind(-1), strict=True))
        return torch.stack([self.mask & known.get(name, ones) for name in names], dim=-1)

    def at_measured_times(self, trajectory: Tensor, names: Sequence[str]) -> Tensor:
        """Returns a simulated trajectory at the times of the measurements.

        Each value is that of a parabola through three neighbouring steps. Values of the first and
        the last step of a segment use the three steps at its end. Segments of fewer steps stay as
        they are.

        Args:
            trajectory: Values at the end of each step, ``(..., S, K, len(names))``.
            names: Names of its channels.
        """
        if self.lateness is None or self.num_steps < 3:
            return trajectory
        zeros = torch.zeros_like(self.lateness[..., 0])
        known = dict(zip(self.channel_names, self.lateness.unbind(-1), strict=True))
        late = torch.stack([known.get(name, zeros) for name in names], dim=-1).to(trajectory)
        step = torch.arange(self.num_steps, device=late.device)
        # Shorter segments are padded with zeros, which no parabola may include.
        last = (self.mask.sum(-1, keepdim=True) - 2).clamp_min(1)
        middle = torch.minimum(step.clamp_min(1), last.to(step)).clamp_max(self.num_steps - 2)
        late = torch.where((self.mask.sum(-1) < 3)[:, None, None], 0.0, late)
        x = late + (step - middle)[..., None]
        weights = (0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0))
        shape = trajectory.shape
        index = middle[..., None].expand(*shape[-3:])
        moved = torch.zeros_like(trajectory)
        for shift, weight in zip((-1, 0, 1), weights, strict=True):
            around = trajectory.gather(-2, (index + shift).expand(shape))
            moved = moved + weight * around
        return torch.where(late == 0.0, trajectory, moved)

    def _unbatched(self, change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Applies a function to the unbatched fields ``(S, …, C)`` that are not ``None``."""
        values = {name: getattr(self, name) for name in _UNBATCHED}
        return {name: change(value) for name, value in values.items() if value is not None}

    def _starts(self, change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Applies a function to the fields of initial states that are not ``None``."""
        values = {name: getattr(self, name) for name in _STARTS}
        return {name: change(value) for name, value in values.items() if value is not None}
