"""Random search, the baseline: perturb the initial parameters and keep the best candidate."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.policies.policy_search import GaussianSearch, SearchSpace, SearchState

__all__ = ["RandomSearch", "RandomSearchState"]


@dataclass(frozen=True)
class RandomSearchState(SearchState):
    """The data that the next iteration needs.

    Attributes:
        start: Initial parameters, ``(P,)``.
        exploration: Standard deviations around them, ``(P,)``.
    """

    start: Tensor
    exploration: Tensor


@dataclass(frozen=True)
class RandomSearch(GaussianSearch[RandomSearchState]):
    """Independent normal perturbations of the initial parameters; deploys the best candidate.

    Args:
        population: Number of candidates per iteration; the initial parameters come first, in
            addition.
        exploration: Standard deviations, one number or one per parameter.
    """

    name: ClassVar[str] = "random"
    summary: ClassVar[str] = "random perturbations of the first policy, the best is kept"
    state_class = RandomSearchState

    def begin(self, space: SearchSpace, start: Tensor) -> dict[str, Tensor]:
        """Returns the tensors of a new state; see :meth:`PolicySearch.begin`."""
        return {"start": start, "exploration": self._per_parameter("exploration", space)}

    def ask(self, state: RandomSearchState, generator: torch.Generator) -> Tensor:
        """Perturbs the initial parameters, the first row; see :meth:`PolicySearch.ask`."""
        return self._perturbed(state, state.start, state.exploration.diag(), generator)

    def learn(
        self, state: RandomSearchState, candidates: Tensor, returns: Tensor
    ) -> RandomSearchState:
        """Returns the state, which already has the best candidate."""
        return state

    def parameters(self, state: RandomSearchState) -> Tensor:
        """Returns the best candidate so far."""
        return state.best
