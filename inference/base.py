"""The protocol of a backend: ask for parameters, tell it simulations, get a density.

A backend works in *reference coordinates* z: a d-dimensional real space in which the prior is the
standard normal wherever the model's distributions allow it. It never calls the simulator, so the
caller owns parallelism, checkpoints and resumption.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from npdr_ppl.inference.linear_problem import LinearRegression
from npdr_ppl.rollouts.differentiation import Smoothing

__all__ = ["Backend", "Density", "Problem", "RoundInfo", "State"]


@dataclass(frozen=True)
class Problem:
    """The model and the data, as a backend sees them.

    Attributes:
        num_parameters: Dimension d of the reference coordinates.
        observation: Features of the observation, ``(F,)`` or a raw array for a trained network.
        sample_prior: Draws n points from the prior, ``(n, d)``, using torch's global stream.
        log_prior: Log density of the prior at points ``(n, d)``, shape ``(n,)``.
        is_prior_standard_normal: Whether the prior is exactly N(0, I).
        build_network: Makes an untrained embedding network for arrays of the observation's shape,
            trained jointly with the estimator; ``None`` if no network is trained.
        device: Where to train.
        log_likelihood: Log density of the recording at points ``(n, d)``, shape ``(n,)``,
            differentiable, for models that have one; ``None`` for black boxes.
        regression: Returns the problem in the form of a linear regression, computed on request;
            ``None`` for a problem without a simulator.
    """

    num_parameters: int
    observation: Tensor
    sample_prior: Callable[[int], Tensor]
    log_prior: Callable[[Tensor], Tensor]
    is_prior_standard_normal: bool = True
    build_network: Callable[[], nn.Module] | None = None
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    log_likelihood: Callable[[Tensor], Tensor] | None = None
    regression: Callable[[Smoothing], LinearRegression] | None = None


class Density(ABC):
    """A density over reference coordinates: one ensemble member's posterior given x_o."""

    @abstractmethod
    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream."""

    @abstractmethod
    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``."""


@dataclass(frozen=True)
class State:
    """The data that the next round needs; each backend extends it."""

    round: int


@dataclass(frozen=True)
class RoundInfo:
    """Figures about one round, for the user.

    Attributes:
        num_simulations: Number of simulations given to the backend in this round.
        num_failed: Of these, how many were dropped because they were not finite.
        seconds: Training time.
        losses: Figures by name, e.g. ``validation_log_prob`` per member.
        faults: Number of worker faults by kind; empty if no workers were used.
    """

    num_simulations: int
    num_failed: int
    seconds: float
    losses: Mapping[str, Any] = field(default_factory=dict)
    faults: Mapping[str, int] = field(default_factory=dict)


class Backend(ABC):
    """An inference method, INFER of Algorithm 1 (Muratore et al. 2021).

    A backend is immutable: its options are constructor arguments, and everything that changes is
    in the state. :meth:`ask` and :meth:`tell` draw from torch's global stream; the caller seeds
    it.

    Attributes:
        name: Word that selects it, e.g. ``"snpe-c"``.
        summary: One line for tables.
        uses_simulations: Whether it learns from simulations. If not, it requests and receives
            none, and has its posterior after one round.
        is_sequential: Whether later rounds learn from earlier ones. If not, a caller with a
            simulation budget should spend it in one round.
        amortises: Whether a state after one round from the prior holds the posterior for any
            observation, not only for the problem's.
        continues: Whether a loop over policies and real rollouts starts each iteration from the
            previous posterior, as NPDR does. If not, it starts from the prior, as BayesSim does.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    uses_simulations: ClassVar[bool] = True
    is_sequential: ClassVar[bool] = True
    amortises: ClassVar[bool] = False
    continues: ClassVar[bool] = True

    @abstractmethod
    def init(self, problem: Problem) -> State:
        """Returns the state before any simulation."""

    @abstractmethod
    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``."""

    def ask_near(
        self, problem: Problem, posterior: Density, num_simulations: int
    ) -> Tensor | None:
        """Proposes a first round near the posterior of an earlier inference of the same model.

        Returns ``None`` if the method cannot correct for such a proposal and must start from the
        prior.
        """
        return None

    @abstractmethod
    def tell(
        self,
        problem: Problem,
        state: State,
        z: Tensor,
        x: Tensor,
        progress: Callable[[float, str], None] | None = None,
    ) -> tuple[State, RoundInfo]:
        """Learns from a round of simulations.

        Args:
            problem: The problem given to :meth:`init`.
            state: The current state.
            z: Parameters simulated, ``(n, d)``.
            x: Their features, ``(n,) + observation.shape``; rows that are not finite failed.
            progress: Called with the fraction done and a short status.

        Returns:
            The next state and the round's figures.
        """

    @abstractmethod
    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""

    def densities_given(
        self, problem: Problem, state: State, observations: Tensor
    ) -> Iterator[list[Density]]:
        """Yields the posterior of every ensemble member given each of several observations.

        Only a backend whose :attr:`amortises` is true supports this. Backends that can share work
        between observations override this method.

        Args:
            problem: The problem given to :meth:`init`.
            state: A state after one round.
            observations: Observations, ``(n,) + observation.shape``.
        """
        for x in observations:
            yield self.densities(replace(problem, observation=x), state)

    @abstractmethod
    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values, to be written to disk."""

    @abstractmethod
    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> State:
        """Rebuilds a state from :meth:`tensors`."""
