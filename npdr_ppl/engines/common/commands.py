"""Present and past commands for action effects, from a recording or from a running loop."""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.language.effects import Commands
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = [
    "CommandRecord",
    "RecentCommands",
    "RecordedCommands",
    "command_records",
    "commands_at",
]


class CommandRecord:
    """All commands of one action channel in a batch of segments, including past ones.

    Commands before a rollout are zero, but a servo already holds the first goal, and so does every
    channel of a recording that began in operation. Commands before the oldest one that is included
    of a running rollout are assumed equal to it.

    Attributes:
        table: Commands in time-major order, flat.
        stride: Entries of the table per time step.
        rows: Entry of each simulation within a time step, ``(N,)``.
        first: Time index of step 0.

    Args:
        inputs: The segments; their actions may carry batch dimensions.
        column: Column of the channel in the inputs' actions.
        batch_shape: The batch shape including the segments, of numel N.
        limits: Least and greatest command that the device accepts.
        dtype: Floating type of the simulation.
        num_past: Number of past commands to keep.
        is_goal: Whether the channel is the goal of a servo.
    """

    def __init__(
        self,
        inputs: Inputs,
        column: int,
        batch_shape: torch.Size,
        limits: tuple[float, float],
        dtype: torch.dtype,
        *,
        num_past: int,
        is_goal: bool = False,
    ) -> None:
        known = inputs.commands(column, num_past=num_past, is_goal=is_goal)
        known = known.to(dtype).clamp(*limits)
        before = known[..., 0]
        if not (is_goal or inputs.began_in_operation):
            before = torch.where(inputs.start == 0, torch.zeros_like(before), before)
        # Time is the first axis, so that the commands of one step are contiguous in memory.
        self._table = torch.cat((before[..., None], known), dim=-1).movedim(-1, 0).contiguous()
        self.table, self.stride = self._table.reshape(-1), self._table[0].numel()
        self._batch_shape: torch.Size | None = batch_shape
        segments = self._table.shape[1:]
        row = torch.arange(segments.numel(), device=known.device).reshape(segments)
        self.rows = row.expand(batch_shape).reshape(-1)
        self.first = 1 + num_past

    @classmethod
    def joined(cls, records: Sequence["CommandRecord"]) -> "CommandRecord":
        """Returns the commands of several channels, one after the other, as those of one.

        Args:
            records: Records of the same segments and simulations.
        """
        one = copy.copy(records[0])
        one._table = torch.stack([record._table for record in records], dim=1)
        one.table, one.stride = one._table.reshape(-1), one._table[0].numel()
        one.rows = torch.cat([record.rows + k * record.stride for k, record in enumerate(records)])
        one._batch_shape = None
        return one

    def at(self, step: int) -> Tensor:
        """Returns the command of each simulation at a step, ``(N,)``; steps before 0 are past."""
        present = self._table[max(0, self.first + step)]
        if self._batch_shape is None:
            return present.reshape(-1)[self.rows]
        return present.expand(self._batch_shape).reshape(-1)

    def view(self, step: int) -> "RecordedCommands":
        """Returns a view of the record at a step."""
        return RecordedCommands(
            self.at(step), self.table, self.rows, self.first + step, self.stride
        )

    def part(self, first: int, last: int) -> "CommandRecord":
        """Returns the record of some neighbouring ones of the N simulations."""
        return self.of(slice(first, last))

    def of(self, index: Tensor | slice) -> "CommandRecord":
        """Returns the record of some of the N simulations."""
        part = copy.copy(self)
        part.rows = self.rows[index]
        part._batch_shape = None
        return part


def command_records(
    simulator: Simulator,
    inputs: Inputs,
    batch_shape: torch.Size,
    dtype: torch.dtype,
    num_past: int,
) -> tuple[CommandRecord, ...]:
    """Returns the commands of each action channel of a simulator; see :class:`CommandRecord`."""
    columns = {name: i for i, name in enumerate(inputs.action_names)}
    return tuple(
        CommandRecord(
            inputs,
            columns[action.name],
            batch_shape,
            (action.lower, action.upper),
            dtype,
            num_past=num_past,
            is_goal=simulator.is_goal(action.name),
        )
        for action in simulator.actions
    )


def commands_at(records: Sequence[CommandRecord], step: int) -> tuple[Tensor, ...]:
    """Returns the command of each action channel at a step; see :meth:`CommandRecord.at`."""
    return tuple(record.at(step) for record in records)


class RecordedCommands(Commands):
    """View of a record at one step.

    Args:
        present: The command of this step, ``(N,)``.
        table: The record's table.
        rows: Entry of each simulation within a time step of the table, ``(N,)``.
        time: Time index of the present command in the table.
        stride: Entries of the table per time step.
    """

    def __init__(
        self,
        present: Tensor,
        table: Tensor,
        rows: Tensor,
        time: Tensor | int,
        stride: Tensor | int,
    ) -> None:
        self._present = present
        self._table, self._rows, self._time, self._stride = table, rows, time, stride

    def now(self) -> Tensor:
        """Returns the present command."""
        return self._present

    def delayed(self, steps: Tensor) -> Tensor:
        """Returns the command of ``steps`` steps ago."""
        time = (self._time - steps.to(self._rows.dtype)).clamp_min(0)
        return self._table[time * self._stride + self._rows]


class RecentCommands(Commands):
    """The present command and a few before it.

    Args:
        present: The command of this step, ``(N,)``.
        past: Earlier commands, latest first.
    """

    def __init__(self, present: Tensor, past: tuple[Tensor, ...]) -> None:
        self._present = present
        self._past = past

    def now(self) -> Tensor:
        """Returns the present command."""
        return self._present

    def delayed(self, steps: Tensor) -> Tensor:
        """Returns the command of ``steps`` steps ago, at most as many as there are."""
        # A chain of selections stays in registers after compilation, unlike a gather.
        command = self._present
        for age, earlier in enumerate(self._past, start=1):
            command = torch.where(steps >= age, earlier, command)
        return command
