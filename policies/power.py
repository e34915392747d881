"""PoWER: policy search by exploration weighted with the returns.

The mean θ of the parameters is perturbed, and moves towards candidates with high returns (Kober &
Peters 2011, *Policy search for motor primitives in robotics*, Machine Learning 84; exploration is
constant during an episode, with covariance between parameters). With the candidates θᵢ of this
iteration and of the memory, their returns Rᵢ and the elite E, the best of them,

    wᵢ = Rᵢ − min_j R_j,
    θ ← θ + Σ_{i∈E} wᵢ (θᵢ − θ) / Σ_{i∈E} wᵢ,
    Σ ← Σ_i wᵢ (θᵢ − θ)(θᵢ − θ)ᵀ / Σ_i wᵢ,        Σ ≽ diag(σ_min²),

both with the previous θ. Taking the elite instead of all candidates is the paper's importance
sampling. The paper uses the returns themselves; here the worst return is subtracted. Returns may
therefore be negative, and adding a constant to all of them, or changing their unit, has no effect.
With higher baselines, for example the median, Σ shrinks faster and the search stops farther from
the optimum of noisy returns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError
from npdr_ppl.policies.policy_search import GaussianSearch, SearchSpace, SearchState

__all__ = ["PoWER", "PoWERState"]


@dataclass(frozen=True)
class PoWERState(SearchState):
    """The data that the next iteration needs.

    Attributes:
        mean: Current parameters θ, ``(P,)``.
        covariance: Exploration Σ, ``(P, P)``.
        floor: Minimum standard deviations σ_min, ``(P,)``.
        memory: Best candidates so far, ``(m, P)``, the best first.
        memory_returns: Their returns, ``(m,)``, as given to :meth:`PoWER.tell`.
    """

    mean: Tensor
    covariance: Tensor
    floor: Tensor
    memory: Tensor
    memory_returns: Tensor


@dataclass(frozen=True)
class PoWER(GaussianSearch[PoWERState]):
    """PoWER; see the module's text for the method. It deploys the mean.

    Candidates in the memory keep their returns. If the domains change, begin a new search.
    Otherwise candidates with high returns in the previous domains slow the search down.

    Args:
        population: Number of perturbed candidates per iteration; the mean comes first, in
            addition.
        memory: Number of best candidates that are kept, the elite.
        exploration: Initial standard deviations, one number or one per parameter.
        floor: Minimum standard deviations, one number or one per parameter.
    """

    name: ClassVar[str] = "power"
    summary: ClassVar[str] = "PoWER: exploration weighted with the returns, with a memory"
    state_class = PoWERState

    memory: int = 10
    floor: float | Sequence[float] = 0.02

    def __post_init__(self) -> None:
        """Validates the options.

        Raises:
            ModelError: One is out of range.
        """
        super().__post_init__()
        if self.memory < 1:
            raise ModelError(f"{self.name}: memory must be at least 1; got {self.memory}.")

    def begin(self, space: SearchSpace, start: Tensor) -> dict[str, Tensor]:
        """Returns the tensors of a new state; see :meth:`PolicySearch.begin`."""
        return {
            "mean": start,
            "covariance": self._per_parameter("exploration", space).square().diag(),
            "floor": self._per_parameter("floor", space),
            "memory": start.new_empty(0, len(start)),
            "memory_returns": start.new_empty(0),
        }

    def ask(self, state: PoWERState, generator: torch.Generator) -> Tensor:
        """Perturbs the mean, which is the first row; see :meth:`PolicySearch.ask`."""
        factor = torch.linalg.cholesky(state.covariance)
        return self._perturbed(state, state.mean, factor, generator)

    def learn(self, state: PoWERState, candidates: Tensor, returns: Tensor) -> PoWERState:
        """Moves mean and covariance; see :meth:`PolicySearch.learn`.

        Accepts any number of candidates, also ones that :meth:`ask` did not propose. Failed ones
        are left out. If all returns are equal, only the memory changes.
        """
        succeeded = returns > -torch.inf
        if not succeeded.any():
            return state
        pool = torch.cat((state.memory, candidates[succeeded]))
        pool_returns = torch.cat((state.memory_returns, returns[succeeded]))
        elite = pool_returns.argsort(descending=True, stable=True)[: self.memory]
        mean, covariance = state.mean, state.covariance
        weight = pool_returns - pool_returns.min()
        if weight.max() > 0:
            weight = weight / weight.max()
            offset = pool - mean
            covariance = offset.T @ (weight[:, None] * offset) / weight.sum()
            covariance = _raised(covariance, state.floor)
            step = weight[elite] @ offset[elite] / weight[elite].sum()
            mean = state.space.clamp(mean + step)  # only against rounding: bounds are convex
        return replace(
            state,
            mean=mean,
            covariance=covariance,
            memory=pool[elite],
            memory_returns=pool_returns[elite],
        )

    def parameters(self, state: PoWERState) -> Tensor:
        """Returns the mean."""
        return state.mean


def _raised(covariance: Tensor, floor: Tensor) -> Tensor:
    """Returns a covariance C with C ≽ diag(floor²), the minimum exploration in every direction.

    Args:
        covariance: Positive semidefinite, ``(P, P)``.
        floor: Standard deviations, ``(P,)``.
    """
    eigenvalues, vectors = torch.linalg.eigh(covariance / floor / floor[:, None])
    raised = vectors @ (eigenvalues.clamp(min=1.0)[:, None] * vectors.T)
    return raised * floor * floor[:, None]
