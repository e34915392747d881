"""CMA-ES: an evolution strategy that adapts its covariance to the steps taken so far.

Hansen (2016), *The CMA evolution strategy: a tutorial*, as implemented by the package ``cmaes``.
It uses only the ranks of the returns, so their scale does not matter.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from cmaes import CMA
from torch import Tensor

from npdr_ppl.errors import ShapeError
from npdr_ppl.policies.policy_search import GaussianSearch, SearchSpace, SearchState

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
class CMAES(GaussianSearch[CMAESState]):
    """CMA-ES with bounds; see the module's text. It deploys the mean of its distribution.

    On the Furuta pendulum its return is below that of PoWER for about ten iterations, and equal
    after forty.

    Args:
        population: Number of candidates per iteration. With returns that have little noise, small
            populations need fewer simulations. The default suits noisy returns and batched
            simulators.
        exploration: Initial standard deviations, one number or one per parameter.
    """

    name: ClassVar[str] = "cma-es"
    summary: ClassVar[str] = "CMA-ES: covariance matrix adaptation by ranks, with bounds"
    state_class = CMAESState
    smallest_population: ClassVar[int] = 5

    def begin(self, space: SearchSpace, start: Tensor) -> dict[str, Tensor]:
        """Returns the tensors of a new state; see :meth:`PolicySearch.begin`."""
        return {
            "start": start,
            "exploration": self._per_parameter("exploration", space),
            "candidates": start.new_empty(0, self.population, len(start)),
            "returns": start.new_empty(0, self.population),
        }

    def ask(self, state: CMAESState, generator: torch.Generator) -> Tensor:
        """Draws candidates, anew if they are out of bounds; see :meth:`PolicySearch.ask`."""
        optimiser = _replayed(state)
        optimiser.reseed_rng(int(torch.randint(2**32, (), generator=generator)))
        rows = [optimiser.ask() for _ in range(state.returns.shape[1])]
        return torch.from_numpy(np.stack(rows))

    def learn(self, state: CMAESState, candidates: Tensor, returns: Tensor) -> CMAESState:
        """Adds a generation; see :meth:`PolicySearch.learn`.

        A generation with equal returns is left out, because its ranks would be the order of the
        rows.

        Raises:
            ShapeError: There are more or fewer candidates than in other generations.
        """
        if len(returns) != state.returns.shape[1]:
            raise ShapeError(
                f"Candidates of a generation must be {state.returns.shape[1]}, got {len(returns)}."
            )
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
