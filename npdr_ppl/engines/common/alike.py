"""Simulations that receive the same commands, and channels whose commands pass the same laws.

A fit simulates a recording with many parameters and initial states, but only a few of them change
what effects on commands do. Past commands influence some effects for seconds, thousands of steps,
so they are passed through the effects once for all simulations in which the result is the same,
and at once for all channels that have the same laws: the servos of an arm.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.common.action_effects import ActionEffects
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.commands import CommandRecord

__all__ = ["Alike", "SameLaws", "alike", "same_laws"]


class Alike(NamedTuple):
    """One simulation of each kind, where those of a kind receive the same commands.

    Attributes:
        state: State of one simulation of each of the U kinds, ``(U,)`` in place of ``(N,)``.
        tables: Constants of these simulations.
        records: Commands of these simulations.
        first: Index of each of these simulations, ``(U,)``.
        kind: Kind of all simulations, ``(N,)``.
    """

    state: State
    tables: Tables
    records: tuple[CommandRecord, ...]
    first: Tensor
    kind: Tensor

    def spread(self, state: State, changed: State) -> State:
        """Returns all simulations with the memory of action effects that their kind has.

        Args:
            state: State of all simulations.
            changed: State of one simulation of each kind.
        """
        return state._replace(
            action_memory=_taken(changed.action_memory, self.kind),
            past_commands=_taken(changed.past_commands, self.kind),
        )


def alike(
    actions: ActionEffects, state: State, tables: Tables, records: tuple[CommandRecord, ...]
) -> Alike:
    """Returns one simulation of each kind.

    Simulations are alike if they have the same segment of the recording and the same parameters
    of the effects on commands. If those have gradients, every simulation is a kind of its own:
    equal values may come from different parameters.

    Args:
        actions: The effects on commands.
        state: State of N simulations.
        tables: Their constants.
        records: Their commands.
    """
    size = len(records[0].rows)
    own = [value for place, _, _ in actions.effects for value in tables.effects[place].values()]
    columns = [records[channel].rows for channel in actions.channels] + own
    numbers = torch.arange(size, device=columns[0].device)
    if any(value.requires_grad for value in own):
        first = kind = numbers
    else:
        # Of each column the ranks of its values: its own type may not hold all others.
        ranks = [torch.unique(c.expand(size), return_inverse=True)[1] for c in columns]
        kinds, kind = torch.unique(torch.stack(ranks, dim=-1), dim=0, return_inverse=True)
        first = numbers.new_full((len(kinds),), size).scatter_reduce(0, kind, numbers, "amin")
    return Alike(
        state._replace(
            action_memory=_taken(state.action_memory, first),
            past_commands=_taken(state.past_commands, first),
        ),
        tables._replace(effects=_taken(tables.effects, first)),
        tuple(record.of(first) for record in records),
        first,
        kind,
    )


class SameLaws(NamedTuple):
    """Channels whose commands pass the same laws, as one channel of C times as many simulations.

    Attributes:
        channels: Indices of the C action channels.
        actions: The effects of one channel, whose index is 0.
        state: State of the C N simulations, channel by channel.
        tables: Constants of these simulations.
        records: Their commands, of one channel.
    """

    channels: tuple[int, ...]
    actions: ActionEffects
    state: State
    tables: Tables
    records: tuple[CommandRecord, ...]


def same_laws(
    actions: ActionEffects, state: State, tables: Tables, records: tuple[CommandRecord, ...]
) -> Iterator[SameLaws]:
    """Yields the channels with effects, those with the same laws together.

    Args:
        actions: The effects on commands.
        state: State of N simulations.
        tables: Their constants.
        records: Their commands.
    """
    numbers: dict[int, list[int]] = defaultdict(list)
    for number, (_, _, channel) in enumerate(actions.effects):
        numbers[channel].append(number)
    together: dict[Hashable, list[int]] = defaultdict(list)
    for channel, own in numbers.items():
        together[tuple(actions.law(number) for number in own)].append(channel)
    size = len(records[0].rows)

    def joined(trees: Sequence[Any]) -> Any:
        """Returns one tree for all channels, whose tensors are joined."""
        return pytree.tree_map(
            lambda *leaves: (
                torch.cat([leaf.expand(size, *leaf.shape[1:]) for leaf in leaves])
                if isinstance(leaves[0], Tensor)
                else leaves[0]
            ),
            trees[0],
            *trees[1:],
        )

    for channels in together.values():
        # Of each law, its number at each of the channels.
        laws = list(zip(*(numbers[channel] for channel in channels), strict=True))
        own = [[tables.effects[actions.effects[number][0]] for number in law] for law in laws]
        yield SameLaws(
            tuple(channels),
            actions.at_one_channel([law[0] for law in laws]),
            state._replace(
                action_memory=tuple(joined([state.action_memory[k] for k in law]) for law in laws),
                past_commands=tuple(joined([state.past_commands[k] for k in law]) for law in laws),
            ),
            tables._replace(effects=tuple(joined(parameters) for parameters in own)),
            (CommandRecord.joined([records[channel] for channel in channels]),),
        )


def _taken(tree: Any, index: Tensor) -> Any:
    """Returns some of the simulations of all tensors; single numbers hold for all of them."""
    return pytree.tree_map_only(Tensor, lambda leaf: leaf[index] if leaf.ndim else leaf, tree)
