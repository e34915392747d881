"""The protocol of a backend: ask for parameters, tell it simulations, get a density.

A backend works in *reference coordinates* z: a d-dimensional real space in which the prior is the
standard normal wherever the model's distributions allow it. It never calls the simulator, so the
caller owns parallelism, checkpoints and resumption.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from time import perf_counter
from typing import Any, ClassVar, Generic, TypeVar, final

import torch
from torch import Tensor, nn

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.rollouts.differentiation import Smoothing

__all__ = ["Backend", "Density", "Problem", "Progress", "RoundInfo", "State"]

logger = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
"""Receives the fraction done and a short status."""


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

    Raises:
        ShapeError: There are no parameters, or the features are not a vector.
        BackendError: The observation is not finite.
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

    def __post_init__(self) -> None:
        """Checks parameters and observation."""
        if self.num_parameters < 1:
            raise ShapeError(f"There must be a parameter to infer, got {self.num_parameters=}.")
        observation = self.observation
        if self.build_network is None and (observation.ndim != 1 or not len(observation)):
            raise ShapeError(
                "Features of an observation must be a vector (F,) unless a network is trained on "
                f"raw arrays; got {tuple(observation.shape)}."
            )
        if not observation.isfinite().all():
            raise BackendError(
                f"{int((~observation.isfinite()).sum())} of {observation.numel()} features of "
                "the observation are not finite; leave them out or choose another embedding."
            )


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


S = TypeVar("S", bound=State)


class Backend(ABC, Generic[S]):
    """An inference method, INFER of Algorithm 1 (Muratore et al. 2021).

    A backend is immutable: its options are constructor arguments, and everything that changes is
    in the state. :meth:`ask` and :meth:`tell` draw from torch's global stream; the caller seeds
    it.

    Attributes:
        name: Word that selects it, e.g. ``"snpe-c"``.
        summary: One line for tables.
        state_class: Class of its states.
        min_simulations: Minimum number of successful simulations in the first round.
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
    state_class: type[S]
    min_simulations: ClassVar[int] = 0
    uses_simulations: ClassVar[bool] = True
    is_sequential: ClassVar[bool] = True
    amortises: ClassVar[bool] = False
    continues: ClassVar[bool] = True

    @abstractmethod
    def init(self, problem: Problem) -> S:
        """Returns the state before any simulation."""

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``.

        By default these are draws of the prior, or none if the backend uses no simulations.
        """
        if not self.uses_simulations:
            return torch.empty(0, problem.num_parameters)
        return problem.sample_prior(num_simulations)

    def ask_near(
        self, problem: Problem, posterior: Density, num_simulations: int
    ) -> Tensor | None:
        """Proposes a first round near the posterior of an earlier inference of the same model.

        Returns ``None`` if the method cannot correct for such a proposal and must start from the
        prior.
        """
        return None

    @final
    def tell(
        self,
        problem: Problem,
        state: State,
        z: Tensor,
        x: Tensor,
        progress: Progress | None = None,
    ) -> tuple[S, RoundInfo]:
        """Learns from a round of simulations.

        Args:
            problem: The problem given to :meth:`init`.
            state: The current state.
            z: Parameters simulated, ``(n, d)``.
            x: Their features, ``(n,) + observation.shape``; rows that are not finite failed.
            progress: Called with the fraction done and a short status.

        Returns:
            The next state and the round's figures.

        Raises:
            ShapeError: The shapes do not fit the problem.
            BackendError: The state is another backend's, parameters are not finite, or too few
                simulations succeeded.
        """
        start = perf_counter()
        own = self._own(state)
        min_rows = self.min_simulations if own.round == 0 else min(1, self.min_simulations)
        rows = _finite_rows(problem, z.detach().cpu(), x.detach().cpu(), min_rows)
        learnt, figures = self.learn(problem, own, *rows, progress or (lambda *_: None))
        info = RoundInfo(len(z), len(z) - len(rows[0]), perf_counter() - start, figures)
        return replace(learnt, round=own.round + 1), info

    @abstractmethod
    def learn(
        self, problem: Problem, state: S, z: Tensor, x: Tensor, progress: Progress
    ) -> tuple[S, dict[str, Any]]:
        """Learns from the successful simulations of a round; :meth:`tell` calls it.

        Args:
            problem: The problem given to :meth:`init`.
            state: The current state.
            z: Parameters of the successful simulations, ``(n, d)``, in float32 on the CPU.
            x: Their features, ``(n,) + observation.shape``.
            progress: Called with the fraction done and a short status.

        Returns:
            The next state, whose ``round`` :meth:`tell` sets, and figures by name.
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

    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values, to be written to disk.

        A backend whose states have attributes other than tensors overrides this method and
        :meth:`restore`.
        """
        own = self._own(state)
        names = [field.name for field in fields(own) if field.name != "round"]
        tensors = {name: getattr(own, name) for name in names}
        return tensors, {"backend": self.name, "round": own.round}

    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> S:
        """Rebuilds a state from :meth:`tensors`; see :meth:`_check_restored` for errors."""
        self._check_restored(problem, tensors, values)
        return self.state_class(round=int(values["round"]), **tensors)

    def _check_restored(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> None:
        """Checks that a state read from disk belongs to the backend and to the problem.

        Axes that are empty in a new state may have any length: simulations or draws.

        Raises:
            BackendError: It is the state of another backend.
            ShapeError: It is the state of another problem.
        """
        if values.get("backend") != self.name:
            raise BackendError(
                f"This state is of backend {values.get('backend')!r}, not {self.name}."
            )
        for name, new in self.tensors(self.init(problem))[0].items():
            expected, found = tuple(new.shape), tuple(tensors[name].shape)
            if len(expected) != len(found) or any(
                e not in (0, f) for e, f in zip(expected, found, strict=True)
            ):
                raise ShapeError(
                    f"This state is of another problem: its {name} has shape {found}, here it is "
                    f"({', '.join(str(e or 'n') for e in expected)})."
                )

    def _own(self, state: State) -> S:
        """Returns the state as this backend's.

        Raises:
            BackendError: It is not.
        """
        if not isinstance(state, self.state_class):
            raise BackendError(f"{self.name} cannot continue from a {type(state).__name__}.")
        return state

    def _told(self, state: State) -> S:
        """Returns the state as this backend's after at least one round.

        Raises:
            BackendError: It is not.
        """
        state = self._own(state)
        if state.round == 0:
            raise BackendError("There is no posterior yet: tell the backend a round first.")
        return state

    def _check_at_least(self, least: float, *options: str) -> None:
        """Checks that options are not below a number.

        Raises:
            BackendError: One is.
        """
        for option in options:
            if not getattr(self, option) >= least:
                raise BackendError(
                    f"{self.name}: {option} must be at least {least}; got {getattr(self, option)}."
                )

    def _check_ranges(self, **ranges: tuple[float, float]) -> None:
        """Checks that options lie in closed ranges.

        Raises:
            BackendError: One does not.
        """
        for option, (low, high) in ranges.items():
            if not low <= getattr(self, option) <= high:
                raise BackendError(
                    f"{self.name}: {option} must lie between {low} and {high}; "
                    f"got {getattr(self, option)}."
                )

    def _check_choice(self, option: str, allowed: Sequence[str]) -> None:
        """Checks that an option is one of the allowed words.

        Raises:
            BackendError: It is not.
        """
        if getattr(self, option) not in allowed:
            raise BackendError(
                f"{self.name}: {option} must be one of {', '.join(allowed)}; "
                f"got {getattr(self, option)!r}."
            )


def _finite_rows(problem: Problem, z: Tensor, x: Tensor, min_rows: int) -> tuple[Tensor, Tensor]:
    """Drops failed simulations, with a warning.

    Args:
        problem: The problem simulated.
        z: Parameters, ``(n, d)``.
        x: Features, ``(n,) + observation.shape``; rows that are not finite failed.
        min_rows: Successful simulations needed.

    Returns:
        The parameters and features of the other rows, in float32.

    Raises:
        ShapeError: The shapes do not fit the problem or each other.
        BackendError: Parameters are not finite, or too few simulations are left.
    """
    if z.ndim != 2 or z.shape[1] != problem.num_parameters:
        raise ShapeError(
            f"Parameters must have shape (n, {problem.num_parameters}), got {tuple(z.shape)}."
        )
    expected = (len(z), *problem.observation.shape)
    if tuple(x.shape) != expected:
        raise ShapeError(f"Features must have shape {expected}, got {tuple(x.shape)}.")
    if not z.isfinite().all():
        raise BackendError("Simulated parameters must be finite; some are NaN or infinite.")
    x = x.to(torch.float32)  # before the test: values that overflow float32 are not usable either
    finite = x.flatten(1).isfinite().all(1)
    num_failed = len(z) - int(finite.sum())
    if num_failed:
        logger.warning("%d of %d simulations failed.", num_failed, len(z))
    if len(z) - num_failed < min_rows:
        raise BackendError(
            f"{num_failed} of {len(z)} simulations failed (their features are not finite); at "
            f"least {min_rows} must succeed. Check the simulator over the whole prior."
        )
    return z[finite].to(torch.float32), x[finite]
