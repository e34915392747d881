"""The action effects of a simulator: what becomes of a command before it reaches the dynamics."""

import copy
import math
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.commands import CommandRecord, RecentCommands
from npdr_ppl.engines.common.compilation import signature
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import ActionEffect, Commands, Uneven
from npdr_ppl.language.simulator import Simulator

__all__ = ["ActionEffects"]

# Steps of past commands from which the memory of action effects at a segment's start is computed,
# if no effect asks for more: longer than the delays of working control loops.
_PAST_STEPS = 64

# What effects with the same law at different channels may differ in.
_OF_CHANNEL = frozenset({"port", "_priors"})


class ActionEffects:
    """Passes commands through the effects on them, one after the other.

    Args:
        simulator: The system and its effects.
        histories: Number of past commands that each effect may need at each of its channels.
            Further numbers are not used.
        time_step: Seconds per step.

    Attributes:
        effects: Index in ``Tables.effects``, effect and action channel of each effect at each of
            its channels.
        channels: Indices of the action channels that have effects.
    """

    def __init__(self, simulator: Simulator, histories: tuple[int, ...], time_step: float) -> None:
        actions = [channel.name for channel in simulator.actions]
        self.effects: list[tuple[int, ActionEffect, int]] = [
            (place, effect, actions.index(name))
            for place, effect in enumerate(simulator.effects)
            if isinstance(effect, ActionEffect)
            for name in effect.channels
        ]
        self.channels = sorted({channel for _, _, channel in self.effects})
        self._histories = histories[: len(self.effects)]
        self._time_step = time_step

    def law(self, number: int) -> Hashable:
        """Returns what the effect of a number does, whatever its channel and its parameters."""
        effect = self.effects[number][1]
        own = {name: value for name, value in vars(effect).items() if name not in _OF_CHANNEL}
        return type(effect), signature(own), self._histories[number]

    def at_one_channel(self, numbers: Sequence[int]) -> Self:
        """Returns the effects of some numbers, in order, as those of channel 0 alone."""
        own = copy.copy(self)
        own.effects = [(k, self.effects[number][1], 0) for k, number in enumerate(numbers)]
        own._histories = tuple(self._histories[number] for number in numbers)
        own.channels = [0]
        return own

    def num_past_steps(self, recorded: int) -> int:
        """Returns from how many steps of past commands a segment's start is computed.

        Args:
            recorded: Number of past steps that are included in the inputs.
        """
        if not self.effects:
            return 0
        steps: dict[int, float] = defaultdict(float)
        for (_, effect, channel), history in zip(self.effects, self._histories, strict=True):
            steps[channel] += effect.memory_time / self._time_step + history
        longest = max(steps.values())
        return min(recorded, max(_PAST_STEPS, math.ceil(min(longest, recorded))))

    def num_kept_steps(self, recorded: int) -> int:
        """Returns how many of the recorded past steps an effect may look at."""
        return min(recorded, max(_PAST_STEPS, self.num_past_steps(recorded)))

    def initial_memory(
        self, commands: Components, tables: Tables, time: Tensor
    ) -> tuple[Any, ...]:
        """Returns the effects' own state after a long time with constant commands.

        Args:
            commands: One per action channel, ``(N,)`` each.
            tables: Constants of the simulation.
            time: Seconds since the rollout began, ``(N,)``.
        """
        return tuple(
            effect.initial_memory(
                commands[channel], Start(time, self._time_step, tables.effects[place], length)
            )
            for (place, effect, channel), length in zip(self.effects, self._histories, strict=True)
        )

    def initial_past(self, commands: Components) -> tuple[Components, ...]:
        """Returns the past commands that each effect may need, if they were constant."""
        return tuple(
            (commands[channel],) * length
            for (_, _, channel), length in zip(self.effects, self._histories, strict=True)
        )

    def act(
        self,
        state: State,
        commands: Components,
        tables: Tables,
        records: tuple[Commands, ...] | None = None,
    ) -> tuple[State, Components, Moments]:
        """Passes the commands of one step through the effects.

        Args:
            state: State at the step's start.
            commands: One per action channel, already within the channel's limits: a device limits
                commands at its input, and recordings contain limited commands.
            tables: Constants of the simulation.
            records: Views of the recorded commands of each channel, if the whole past is recorded;
                those of channels without effects are not used.

        Returns:
            The state with the effects' memory advanced, the actions after all effects, and their
            moments; see :meth:`EffectChain.move`.
        """
        if not self.effects:
            return state, commands, ()
        views = {} if records is None else dict(enumerate(records))
        state, reached, moments = self._passed(state, dict(enumerate(commands)), tables, views)
        return state, tuple(reached.values()), tuple(moments.get(k) for k in reached)

    def act_on_record(
        self,
        state: State,
        records: Sequence[CommandRecord],
        step: int,
        tables: Tables,
    ) -> tuple[State, dict[int, Tensor], dict[int, Tensor]]:
        """Passes recorded commands of one step through the effects, where there are effects.

        Of an arm with many joints, most commands have none. To read them all for thousands of past
        steps would take most of the time of a simulation.

        Args:
            state: State at the step's start.
            records: Commands of each action channel.
            step: The step; those before 0 are past.
            tables: Constants of the simulation.

        Returns:
            The state with the effects' memory advanced; by channel with effects, the action after
            them; and its moment where it has one, see :meth:`EffectChain.move`.
        """
        views = {channel: records[channel].view(step) for channel in self.channels}
        commands = {channel: view.now() for channel, view in views.items()}
        return self._passed(state, commands, tables, views)

    def _passed(
        self,
        state: State,
        commands: dict[int, Tensor],
        tables: Tables,
        views: Mapping[int, Commands],
    ) -> tuple[State, dict[int, Tensor], dict[int, Tensor]]:
        """Passes commands through the effects; see :meth:`act_on_record`.

        Args:
            state: State at the step's start.
            commands: Commands by channel.
            tables: Constants of the simulation.
            views: Views of the recorded commands by channel; empty if they are not recorded.
        """
        present = dict(commands)
        moments: dict[int, Tensor] = {}
        memory, past = list(state.action_memory), list(state.past_commands)
        is_raw = dict.fromkeys(present, True)
        for k, (place, effect, channel) in enumerate(self.effects):
            # The first effect of a chain can use the record. Later effects receive the output of
            # the effect before them and keep a history of it.
            command = present[channel]
            if views and is_raw[channel]:
                seen = views[channel]
            else:
                seen = RecentCommands(command, past[k])
            reached, memory[k] = effect.act(
                seen, tables.effects[place], memory[k], self._time_step
            )
            if isinstance(reached, Uneven):
                reached, moment = reached
                known = moments.get(channel)
                moments[channel] = moment if known is None else known + moment
            present[channel] = reached
            if self._histories[k]:
                past[k] = (command, *past[k][:-1])
            is_raw[channel] = False
        changed = state._replace(action_memory=tuple(memory), past_commands=tuple(past))
        return changed, present, moments

    def by_substep(
        self, actions: Components, moments: Moments, substeps: int
    ) -> tuple[list[Components], Moments]:
        """Divides actions that change within a step among its substeps.

        An action is replaced by a straight line with the same mean and moment over the step.

        Args:
            actions: Mean of each action, see :meth:`EffectChain.move`.
            moments: Their moments.
            substeps: Number of substeps.

        Returns:
            The mean of each action in each substep, and its moment within a substep.
        """
        own = tuple(None if m is None else m / substeps**3 for m in moments)
        if all(moment is None for moment in own):
            return [actions] * substeps, own
        rise = 12.0 * (substeps / self._time_step) ** 2
        means = [
            tuple(
                a if m is None else torch.add(a, m, alpha=rise * (k - 0.5 * (substeps - 1)))
                for a, m in zip(actions, own, strict=True)
            )
            for k in range(substeps)
        ]
        return means, own
