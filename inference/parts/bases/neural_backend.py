"""Base class of backends that train an ensemble of networks: data, training, state on disk.

A method defines the networks, the loss and the simulations to use; :class:`NeuralBackend` does the
rest. Every round trains anew on the simulations so far.
"""

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend, Problem, Progress, State
from npdr_ppl.inference.parts.training.ensemble_training import (
    Evaluator,
    Loss,
    TrainingOptions,
    in_turn,
    train,
    vectorised,
)
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, fit_preconditioner
from npdr_ppl.randomness import seeded

__all__ = ["NeuralBackend", "NeuralState", "Simulations"]

logger = logging.getLogger(__name__)

MIN_SIMULATIONS = 10
"""Minimum number of simulations: fewer allow no held-out set and no estimate of a covariance."""


@dataclass(frozen=True)
class Simulations:
    """Successful simulations.

    Attributes:
        z: Parameters, ``(n, d)``.
        x: Features, ``(n,) + observation.shape``.
        rounds: The round each came from, ``(n,)``.
    """

    z: Tensor
    x: Tensor
    rounds: Tensor

    def __len__(self) -> int:
        return len(self.z)

    def __getitem__(self, rows: Tensor) -> "Simulations":
        return Simulations(self.z[rows], self.x[rows], self.rounds[rows])

    def followed_by(self, z: Tensor, x: Tensor, number: int) -> "Simulations":
        """Returns these simulations and those of a round."""
        rounds = torch.full((len(z),), number, dtype=torch.long)
        return Simulations(
            torch.cat((self.z, z)), torch.cat((self.x, x)), torch.cat((self.rounds, rounds))
        )


@dataclass(frozen=True)
class NeuralState(State):
    """The data that the next round needs.

    Attributes:
        simulations: All successful simulations.
        weights: The networks' parameters and buffers by name, each ``(members, ...)``; empty
            before the first round.
        preconditioner: The preconditioner of the networks' data.
    """

    simulations: Simulations
    weights: Mapping[str, Tensor]
    preconditioner: Preconditioner | None


@dataclass(frozen=True)
class NeuralBackend(TrainingOptions, Backend[NeuralState]):
    """A backend that trains an ensemble of networks on preconditioned simulations.

    Args:
        members: Number of independently trained networks; the posterior is the mixture of theirs.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.training.ensemble_training.TrainingOptions`.
    """

    state_class = NeuralState
    min_simulations: ClassVar[int] = MIN_SIMULATIONS

    objective: ClassVar[str] = "validation_log_prob"
    """Name of the figure that training maximises."""

    preconditioner_type: ClassVar[type[Preconditioner]] = Preconditioner
    """Type of the result of :meth:`_precondition`."""

    members: int = 2

    def __post_init__(self) -> None:
        """Validates the common options; a method adds its own."""
        self._check_at_least(1, "members", "epochs", "batch_size", "patience")
        self._check_at_least(1e-12, "learning_rate")
        self._check_at_least(0.0, "weight_decay")
        self._check_ranges(averaging=(0.0, 1 - 1e-9), validation_fraction=(1e-9, 0.9))

    def _check_widths(self, option: str) -> None:
        """Makes an option a tuple and checks that it holds widths of hidden layers.

        Raises:
            BackendError: It does not.
        """
        widths = tuple(getattr(self, option))
        object.__setattr__(self, option, widths)
        if not widths or min(widths) < 1:
            raise BackendError(f"{self.name}: {option} must name positive widths; got {widths}.")

    @abstractmethod
    def _networks(self, problem: Problem) -> Sequence[nn.Module]:
        """Returns the ensemble's untrained networks, drawing from torch's global stream."""

    def _starting_networks(
        self,
        problem: Problem,
        state: NeuralState,
        preconditioner: Preconditioner,
        simulations: Simulations,
    ) -> Sequence[nn.Module]:
        """Returns the networks that a round's training starts from: untrained ones.

        Args:
            problem: The problem.
            state: The state before the round.
            preconditioner: The preconditioner of the round.
            simulations: Simulations on which the round trains.
        """
        return self._networks(problem)

    def _trained_networks(self, problem: Problem, weights: Mapping[str, Tensor]) -> Sequence[Any]:
        """Returns the ensemble with trained weights on the problem's device, for evaluation."""
        with seeded(0, "untrained networks"):  # leaves the caller's random stream unchanged
            networks = self._networks(problem)
        for k, network in enumerate(networks):
            network.load_state_dict({name: weights[name][k] for name in network.state_dict()})
            network.requires_grad_(False).eval().to(problem.device)
        return networks

    def _evaluator(self, problem: Problem) -> Evaluator:
        """Returns the joint evaluation of all networks; embedding networks run one by one."""
        return vectorised if problem.build_network is None else in_turn

    @abstractmethod
    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective of the current round on the problem's device."""

    def _validation_loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss | None:
        """Returns the objective at held-out rows if :meth:`_loss` is random, else ``None``."""
        return None

    def _calibration(
        self,
        problem: Problem,
        preconditioner: Preconditioner,
        simulations: Simulations,
        weights: Mapping[str, Tensor],
        held_out: Tensor,
    ) -> dict[str, Tensor]:
        """Returns values fitted after training and stored with the weights; none by default.

        Args:
            problem: The problem.
            preconditioner: The preconditioner of the round.
            simulations: Simulations on which the round trained.
            weights: The trained networks' parameters and buffers.
            held_out: Indices of the simulations that each member held out, ``(members, n)``.
        """
        return {}

    def _training_rows(self, problem: Problem, state: NeuralState) -> Tensor:
        """Returns which of the earlier rounds' simulations to train on, ``(n,)``."""
        return torch.ones(len(state.simulations), dtype=torch.bool)

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        """Returns the preconditioner of the current round's networks."""
        is_raw = problem.build_network is not None
        return fit_preconditioner(simulations.z, simulations.x, is_raw)

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation."""
        none = Simulations(
            torch.empty(0, problem.num_parameters),
            torch.empty(0, *problem.observation.shape),
            torch.empty(0, dtype=torch.long),
        )
        return NeuralState(0, none, {}, None)

    def learn(
        self, problem: Problem, state: NeuralState, z: Tensor, x: Tensor, progress: Progress
    ) -> tuple[NeuralState, dict[str, Any]]:
        """Trains the ensemble anew on the simulations so far; see :meth:`Backend.learn`."""
        simulations = state.simulations.followed_by(z, x, state.round)
        used = torch.ones(len(simulations), dtype=torch.bool)
        used[: len(state.simulations)] = self._training_rows(problem, state)
        rows = simulations[used]
        preconditioner = self._precondition(problem, rows)
        clipped = self._clipped_features(problem, preconditioner)
        device = problem.device
        fit = train(
            self._starting_networks(problem, state, preconditioner, rows),
            self._loss(problem, preconditioner.to(device), rows),
            len(rows),
            self,
            device,
            evaluator=self._evaluator(problem),
            progress=progress,
            validation_loss=self._validation_loss(problem, preconditioner.to(device), rows),
        )
        weights = {name: value.cpu() for name, value in fit.weights.items()}
        weights |= self._calibration(problem, preconditioner, rows, weights, fit.held_out.cpu())
        figures = {
            self.objective: self._objective(fit.validation.cpu(), preconditioner).tolist(),
            "best_epoch": fit.best_epochs.tolist(),
            "epochs": fit.epochs,
            "trained_on": len(rows),
            "clipped_features": clipped,
        }
        state = replace(
            state, simulations=simulations, weights=weights, preconditioner=preconditioner
        )
        return state, figures

    def _objective(self, validation: Tensor, preconditioner: Preconditioner) -> Tensor:
        """Returns the validation objective in the units of the reference coordinates."""
        return validation + preconditioner.log_det

    def _clipped_features(self, problem: Problem, preconditioner: Preconditioner) -> int:
        """Counts the observation's features outside the simulated range and logs a warning."""
        clipped = self._outside(problem, preconditioner)
        if clipped.any():
            logger.warning(
                "%d of %d features of the observation lie outside the simulated range and were "
                "clipped to it: %s. The model may be wrong or its prior too narrow.",
                int(clipped.sum()),
                clipped.numel(),
                clipped.flatten().nonzero().flatten().tolist()[:10],
            )
        return int(clipped.sum())

    def _outside(self, problem: Problem, preconditioner: Preconditioner) -> Tensor:
        """Returns which of the observation's features lie outside the simulated range."""
        return preconditioner.outside(problem.observation.cpu())

    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values."""
        state = self._own(state)
        own = state.simulations
        tensors = {"z": own.z, "x": own.x, "rounds": own.rounds}
        tensors |= {f"weights.{name}": value for name, value in state.weights.items()}
        if state.preconditioner is not None:
            parts = state.preconditioner.tensors()
            tensors |= {f"preconditioner.{name}": value for name, value in parts.items()}
        return tensors, {"backend": self.name, "round": state.round}

    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> NeuralState:
        """Rebuilds a state from :meth:`tensors`; see :meth:`Backend.restore`."""
        self._check_restored(problem, tensors, values)
        z, x = tensors["z"], tensors["x"]
        parts = {
            prefix: {
                name.removeprefix(f"{prefix}."): value
                for name, value in tensors.items()
                if name.startswith(f"{prefix}.")
            }
            for prefix in ("weights", "preconditioner")
        }
        fitted = parts["preconditioner"]
        return NeuralState(
            round=int(values["round"]),
            simulations=Simulations(z, x, tensors["rounds"]),
            weights=parts["weights"],
            preconditioner=self.preconditioner_type.from_tensors(fitted) if fitted else None,
        )

    def _trained(self, state: State) -> tuple[NeuralState, Preconditioner]:
        """Returns a state with simulations, and its preconditioner.

        Raises:
            BackendError: The state has no simulations.
        """
        state = self._told(state)
        assert state.preconditioner is not None
        return state, state.preconditioner
