"""The protocol of a policy search: ask for candidates, tell it their returns, get a policy.

A search uses parameter vectors and their returns, never a simulator. The caller is responsible for
the domains, the initial states and checkpoints.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Generic, Self, TypeVar, final

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.policies.base import Policy

__all__ = ["GaussianSearch", "PolicySearch", "SearchSpace", "SearchState"]


@dataclass(frozen=True)
class SearchSpace:
    """The search space.

    Attributes:
        names: Names of the P parameters.
        lower: Their least values, ``(P,)``, in float64.
        upper: Their greatest values, ``(P,)``.
    """

    names: tuple[str, ...]
    lower: Tensor
    upper: Tensor

    @classmethod
    def of(cls, policy: Policy) -> Self:
        """Returns the bounds of a policy's parameters.

        Raises:
            ModelError: The policy has no parameters.
        """
        if not policy.names:
            raise ModelError(f"{type(policy).__name__} has no parameters that could be searched.")
        lower, upper = policy.bounds
        return cls(policy.names, lower.double(), upper.double())

    def clamp(self, parameters: Tensor) -> Tensor:
        """Moves parameters, ``(..., P)``, to the nearest values within the bounds."""
        return torch.minimum(torch.maximum(parameters, self.lower), self.upper)


@dataclass(frozen=True)
class SearchState:
    """The data that the next iteration needs; each search extends it, by tensors only.

    Attributes:
        space: Names and bounds of the parameters.
        iteration: Number of calls of :meth:`PolicySearch.tell` so far.
        best: Best candidate so far, ``(P,)``; before any, the initial parameters.
        best_return: Its return, as given to :meth:`PolicySearch.tell`; −∞ before any.
    """

    space: SearchSpace
    iteration: int
    best: Tensor
    best_return: Tensor


S = TypeVar("S", bound=SearchState)


class PolicySearch(ABC, Generic[S]):
    """A way to improve a policy's parameters, POLOPT of Algorithm 1 (Muratore et al. 2021).

    A search is immutable: its options are constructor arguments, and everything that changes is in
    the state. Parameters, returns and states are float64 tensors on the CPU.

    Attributes:
        name: Word that selects it, e.g. ``"power"``.
        summary: One line for tables.
        state_class: Class of its states.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    state_class: type[S]

    def init(self, policy: Policy) -> S:
        """Returns the state of a search that begins at ``policy.parameters``.

        Raises:
            ModelError: The policy has no parameters, or they are not finite or out of bounds.
            ShapeError: It is a batch of policies, or an option has another number of parameters.
        """
        space = SearchSpace.of(policy)
        start = policy.parameters.detach().cpu()
        if start.ndim != 1:
            raise ShapeError(
                f"A search begins at one policy, parameters of shape ({len(space.names)},); got "
                f"{tuple(start.shape)}."
            )
        # Compared in the bounds' own precision: a float64 default may differ by rounding from
        # its bound.
        lower, upper = policy.bounds
        outside = ~((start.to(lower) >= lower) & (start.to(upper) <= upper) & start.isfinite())
        if outside.any():
            wrong = [name for name, out in zip(space.names, outside, strict=True) if out]
            raise ModelError(
                f"A search must begin within the bounds; {', '.join(wrong)} of "
                f"{type(policy).__name__} are not."
            )
        start = space.clamp(start.double())
        return self.state_class(
            space=space,
            iteration=0,
            best=start,
            best_return=start.new_tensor(-torch.inf),
            **self.begin(space, start),
        )

    @abstractmethod
    def begin(self, space: SearchSpace, start: Tensor) -> dict[str, Tensor]:
        """Returns the tensors that the search adds to a state, before it has any returns.

        Args:
            space: Names and bounds of the parameters.
            start: Parameters to begin at, ``(P,)``, within the bounds.
        """

    @abstractmethod
    def ask(self, state: S, generator: torch.Generator) -> Tensor:
        """Proposes parameters to try, ``(population, P)``, within the bounds.

        Args:
            state: The current state.
            generator: Source of all randomness, on the CPU.
        """

    @final
    def tell(self, state: S, candidates: Tensor, returns: Tensor) -> S:
        """Learns from an iteration.

        Args:
            state: The state that was asked.
            candidates: Parameters tried, ``(population, P)``.
            returns: Their returns, ``(population,)``, each the mean over domains and initial
                states; one that is not finite counts as the worst.

        Raises:
            ShapeError: The shapes do not fit.
            ModelError: Candidates are not finite.
        """
        expected = (max(1, len(candidates)), len(state.space.names))
        if tuple(candidates.shape) != expected:
            raise ShapeError(
                f"Candidates must have shape {expected}, got {tuple(candidates.shape)}."
            )
        if tuple(returns.shape) != expected[:1]:
            raise ShapeError(
                f"Returns must have shape {expected[:1]}, got {tuple(returns.shape)}."
            )
        if not candidates.isfinite().all():
            raise ModelError("Candidates must be finite; some are NaN or infinite.")
        candidates, returns = candidates.detach().cpu().double(), returns.detach().cpu().double()
        returns = returns.where(returns.isfinite(), -torch.inf)
        state = replace(state, iteration=state.iteration + 1)
        index = returns.argmax()
        if returns[index] > state.best_return:
            best, best_return = candidates[index].clone(), returns[index].clone()
            state = replace(state, best=best, best_return=best_return)
        return self.learn(state, candidates, returns)

    @abstractmethod
    def learn(self, state: S, candidates: Tensor, returns: Tensor) -> S:
        """Learns from an iteration; :meth:`tell` calls it.

        Args:
            state: The state that was asked, its iteration and best candidate already updated.
            candidates: Parameters tried, ``(population, P)``, in float64 on the CPU.
            returns: Their returns, ``(population,)``; −∞ for failures.
        """

    @abstractmethod
    def parameters(self, state: S) -> Tensor:
        """Returns the parameters to deploy, ``(P,)``.

        They may never have been tried, for example if they are a mean. If simulations are cheap,
        try them and ``state.best`` again on the same domains, and deploy the better ones.
        """

    def tensors(self, state: S) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values, to be written to disk."""
        tensors = {name: getattr(state, name) for name in self._tensor_names()}
        bounds = {"lower": state.space.lower, "upper": state.space.upper}
        names = list(state.space.names)
        return tensors | bounds, {
            "search": self.name,
            "iteration": state.iteration,
            "names": names,
        }

    def restore(
        self, policy: Policy, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> S:
        """Rebuilds a state from :meth:`tensors`.

        Raises:
            ModelError: It is the state of another search, or of other parameters or bounds.
        """
        if values.get("search") != self.name:
            raise ModelError(
                f"This state is of policy search {values.get('search')!r}, not {self.name!r}."
            )
        space = SearchSpace.of(policy)
        if (
            tuple(values["names"]) != space.names
            or not torch.equal(tensors["lower"], space.lower)
            or not torch.equal(tensors["upper"], space.upper)
        ):
            raise ModelError(
                f"This state is of a search over {', '.join(values['names'])}. Their names or "
                f"bounds differ from those of {type(policy).__name__}; begin a new search."
            )
        own = {name: tensors[name] for name in self._tensor_names()}
        return self.state_class(space=space, iteration=int(values["iteration"]), **own)

    def _tensor_names(self) -> list[str]:
        """Returns the attributes of a state that are tensors."""
        names = [field.name for field in fields(self.state_class)]
        return [name for name in names if name not in ("space", "iteration")]


@dataclass(frozen=True)
class GaussianSearch(PolicySearch[S]):
    """A search that draws candidates from a normal distribution.

    Args:
        population: Number of candidates per iteration.
        exploration: Initial standard deviations, one number or one per parameter.
    """

    smallest_population: ClassVar[int] = 1

    population: int = 50
    exploration: float | Sequence[float] = 2.0

    def __post_init__(self) -> None:
        """Validates the options.

        Raises:
            ModelError: The population is too small.
        """
        if self.population < self.smallest_population:
            raise ModelError(
                f"{self.name}: population must be at least {self.smallest_population}; "
                f"got {self.population}."
            )

    def _perturbed(
        self, state: S, mean: Tensor, factor: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Returns the mean and ``population`` draws of N(mean, F Fᵀ), moved into the bounds.

        Args:
            state: The current state.
            mean: Mean, ``(P,)``.
            factor: F, ``(P, P)``.
            generator: Source of all randomness.
        """
        noise = torch.randn(self.population, len(mean), generator=generator, dtype=torch.float64)
        return state.space.clamp(torch.cat((mean[None], mean + noise @ factor.T)))

    def _per_parameter(self, option: str, space: SearchSpace) -> Tensor:
        """Returns an option, given as one number or one per parameter, as ``(P,)``.

        Raises:
            ShapeError: There are more or fewer values than parameters.
            ModelError: A value is not positive and finite.
        """
        values = torch.as_tensor(getattr(self, option), dtype=torch.float64)
        if values.ndim and values.shape != (len(space.names),):
            raise ShapeError(
                f"{option} is one number or one for each of {', '.join(space.names)}; got "
                f"{tuple(values.shape)}."
            )
        if not ((values > 0) & values.isfinite()).all():
            raise ModelError(f"{option} must be positive and finite, got {getattr(self, option)}.")
        return values.expand(len(space.names)).clone()
