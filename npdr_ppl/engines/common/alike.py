"""Simulations that receive the same commands.

A fit simulates a recording with many parameters and initial states, but only a few of them change
what effects on commands do. Past commands influence some effects for seconds, thousands of steps,
so they are passed through the effects once for all simulations in which the result is the same.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.common.action_effects import ActionEffects
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.commands import CommandRecord

__all__ = ["Alike", "alike"]


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
    of the effects on commands.

    Args:
        actions: The effects on commands.
        state: State of N simulations.
        tables: Their constants.
        records: Their commands.
    """
    size = len(records[0].rows)
    own = [value for place, _, _ in actions.effects for value in tables.effects[place].values()]
    columns = [records[channel].rows for channel in actions.channels] + own
    keys = torch.stack([c.detach().double().expand(size) for c in columns], dim=-1)
    kinds, kind = torch.unique(keys, dim=0, return_inverse=True)
    numbers = torch.arange(size, device=kind.device)
    first = torch.full((len(kinds),), size, device=kind.device)
    first = first.scatter_reduce(0, kind, numbers, "amin")
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


def _taken(tree: Any, index: Tensor) -> Any:
    """Returns some of the simulations of all tensors; single numbers hold for all of them."""
    return pytree.tree_map_only(Tensor, lambda leaf: leaf[index] if leaf.ndim else leaf, tree)
