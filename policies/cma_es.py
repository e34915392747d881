"""CMA-ES: an evolution strategy that adapts its covariance along the path that it has taken.

Hansen (2016), *The CMA evolution strategy: a tutorial*, as implemented by the package ``cmaes``.
It sees ranks of returns only, so their scale does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from cmaes import CMA
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

__all__ = ["CMAES", "CMAESState"]


@dataclass(frozen=True)
class CMAESState(SearchState):
    """What the next iteration needs: all that CMA-ES was told, which it is told again.

    So the state needs nothing of the package's insides. Replaying costs 0.1 ms per iteration so
    far for seven parameters, more for more.

    Attributes:
        start: Parameters at which the search began, ``(P,)``.
        exploration: Standard deviations at first, ``(P,)``.
        candidates: Parameters tried, ``(generations, population, P)``; iterations that taught
            nothing are left out.
        returns: Their returns, ``(generations, population)``.
    """

    start: Tensor
    exploration: Tensor
    candidates: Tensor
    returns: Tensor


@dataclass(frozen=True)
class CMAES(PolicySearch[CMAESState]):
    """CMA-ES with bounds; see the module's text. It deploys the mean of its distribution.

    On the Furuta pendulum it trails PoWER for some ten iterations and is on a par after forty.

    Args:
        population: Candidates per iteration. Small populations need fewer simulations of quiet
            returns; the default suits noisy ones and simulators that run batches.
        exploration: Standard deviations at first, one number or one per parameter.
    """

    name: ClassVar[str] = "cma-es"
    summary: ClassVar[str] = "CMA-ES: covariance matrix adaptation by ranks, with bounds"
    state_class = CMAESState

    population: int = 50
    exploration: float | Sequence[float] = 2.0

    def __post_init__(self) -> None:
        """Validates the options.

        Raises:
            ModelError: One is out of range.
        """
        if self.population < 5:
            raise ModelError(f"{self.name}: population must be at least 5; got {self.population}.")

    def begin(self, space: SearchSpace, start: Tensor) -> CMAESState:
        """Returns the state before any return is told; see :meth:`PolicySearch.begin`."""
        return CMAESState(
            space=space,
            iteration=0,
            best=start,
            best_return=start.new_tensor(-torch.inf),
            start=start,
            exploration=per_parameter("exploration", self.exploration, space),
            candidates=start.new_empty(0, self.population, len(start)),
            returns=start.new_empty(0, self.population),
        )

    def ask(self, state: CMAESState, generator: torch.Generator) -> Tensor:
        """Draws candidates, again where they are out of bounds; see :meth:`PolicySearch.ask`."""
        optimiser = _replayed(state)
        optimiser.reseed_rng(int(torch.randint(2**32, (), generator=generator)))
        rows = [optimiser.ask() for _ in range(state.returns.shape[1])]
        return torch.from_numpy(np.stack(rows))

    def tell(self, state: CMAESState, candidates: Tensor, returns: Tensor) -> CMAESState:
        """Adds a generation; see :meth:`PolicySearch.tell`.

        One whose returns are all the same is left out: their order would be that of the rows.
        """
        candidates, returns = checked(state, candidates, returns, state.returns.shape[1])
        state = counted(state, candidates, returns)
        if returns.max() == returns.min():
            return state
        return replace(
            state,
            candidates=torch.cat((state.candidates, candidates[None])),
            returns=torch.cat((state.returns, returns[None])),
        )

    def parameters(self, state: CMAESState) -> Tensor:
        """Returns the mean of the distribution."""
        return state.space.clamp(torch.from_numpy(_replayed(state).mean))


def _replayed(state: CMAESState) -> CMA:
    """Returns the optimiser after all generations; it holds nothing that is not in the state."""
    optimiser = CMA(
        mean=state.start.numpy(),
        sigma=1.0,
        cov=state.exploration.square().diag().numpy(),
        bounds=torch.stack((state.space.lower, state.space.upper), 1).numpy(),
        population_size=state.returns.shape[1],
        seed=0,  # never used: asking seeds anew
    )
    for candidates, returns in zip(state.candidates, state.returns, strict=True):
        # It minimises, and sorts failures, now +∞, to the end.
        optimiser.tell(list(zip(candidates.numpy(), (-returns).tolist(), strict=True)))
    return optimiser
