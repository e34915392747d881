"""CMA-ES: an evolution strategy that adapts its covariance to the steps taken so far.

Hansen (2016), *The CMA evolution strategy: a tutorial*, as implemented by the package ``cmaes``.
It uses only the ranks of the returns, so their scale does not matter.
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
    """The data that the next iteration needs: all candidates and returns, which are replayed.

    The state is thus independent of the package's internals. With seven parameters replaying takes
    0.1 ms per past iteration, with more parameters longer.

    Attributes:
        start: Initial parameters, ``(P,)``.
        exploration: Initial standard deviations, ``(P,)``.
        candidates: Parameters tried, ``(generations, population, P)``; iterations with equal
            returns are left out.
        returns: Their returns, ``(generations, population)``.
    """

    start: Tensor
    exploration: Tensor
    candidates: Tensor
    returns: Tensor


@dataclass(frozen=True)
class CMAES(PolicySearch[CMAESState]):
    """CMA-ES with bounds; see the module's text. It deploys the mean of its distribution.

    On the Furuta pendulum it is behind PoWER for about ten iterations and equal after forty.

    Args:
        population: Number of candidates per iteration. With returns that have little noise, small
            populations need fewer simulations. The default suits noisy returns and batched
            simulators.
        exploration: Initial standard deviations, one number or one per parameter.
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
        """Draws candidates, anew if they are out of bounds; see :meth:`PolicySearch.ask`."""
        optimiser = _replayed(state)
        optimiser.reseed_rng(int(torch.randint(2**32, (), generator=generator)))
        rows = [optimiser.ask() for _ in range(state.returns.shape[1])]
        return torch.from_numpy(np.stack(rows))

    def tell(self, state: CMAESState, candidates: Tensor, returns: Tensor) -> CMAESState:
        """Adds a generation; see :meth:`PolicySearch.tell`.

        A generation with equal returns is left out, because its ranks would be the order of the
        rows.
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
    """Returns the optimiser after all generations, built from the state alone."""
    optimiser = CMA(
        mean=state.start.numpy(),
        sigma=1.0,
        cov=state.exploration.square().diag().numpy(),
        bounds=torch.stack((state.space.lower, state.space.upper), 1).numpy(),
        population_size=state.returns.shape[1],
        seed=0,  # never used: ask() sets the seed
    )
    for candidates, returns in zip(state.candidates, state.returns, strict=True):
        # It minimises; failures become +∞ and are sorted to the end.
        optimiser.tell(list(zip(candidates.numpy(), (-returns).tolist(), strict=True)))
    return optimiser
