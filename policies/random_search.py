"""Random search, the baseline: perturb the initial parameters and keep the best candidate."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError
from npdr_ppl.policies.policy_search import (
    PolicySearch,
    SearchSpace,
    SearchState,
    checked,
    counted,
    per_parameter,
)

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
class RandomSearch(PolicySearch[RandomSearchState]):
    """Independent normal perturbations of the initial parameters; deploys the best candidate.

    Args:
        population: Number of candidates per iteration; the initial parameters come first, in
            addition.
        exploration: Standard deviations, one number or one per parameter.
    """

    name: ClassVar[str] = "random"
    summary: ClassVar[str] = "random perturbations of the first policy, the best is kept"
    state_class = RandomSearchState

    population: int = 50
    exploration: float | Sequence[float] = 2.0

    def __post_init__(self) -> None:
        """Validates the options.

        Raises:
            ModelError: One is out of range.
        """
        if self.population < 1:
            raise ModelError(f"{self.name}: population must be at least 1; got {self.population}.")

    def begin(self, space: SearchSpace, start: Tensor) -> RandomSearchState:
        """Returns the state before any return is told; see :meth:`PolicySearch.begin`."""
        return RandomSearchState(
            space=space,
            iteration=0,
            best=start,
            best_return=start.new_tensor(-torch.inf),
            start=start,
            exploration=per_parameter("exploration", self.exploration, space),
        )

    def ask(self, state: RandomSearchState, generator: torch.Generator) -> Tensor:
        """Perturbs the initial parameters, the first row; see :meth:`PolicySearch.ask`."""
        noise = torch.randn(
            self.population, len(state.start), generator=generator, dtype=torch.float64
        )
        perturbed = state.start + state.exploration * noise
        return state.space.clamp(torch.cat((state.start[None], perturbed)))

    def tell(
        self, state: RandomSearchState, candidates: Tensor, returns: Tensor
    ) -> RandomSearchState:
        """Remembers the best candidate; see :meth:`PolicySearch.tell`.

        Accepts any number of candidates, also ones that :meth:`ask` did not propose.
        """
        candidates, returns = checked(state, candidates, returns)
        return counted(state, candidates, returns)

    def parameters(self, state: RandomSearchState) -> Tensor:
        """Returns the best candidate so far."""
        return state.best
