"""SNPE-C: sequential neural posterior estimation with normalising flows.

Greenberg, Nonnenmacher & Macke (2019), *Automatic Posterior Transformation for Likelihood-Free
Inference*, https://arxiv.org/abs/1905.07488; it continues Papamakarios & Murray (2016) and
Lueckmann et al. (2017). Each round r of Algorithm 1

1. draws parameters z_n from a proposal p_r(z), the prior in the first round,
2. simulates features x_n ~ p(x | z_n),
3. trains a conditional flow q(z | x) on the simulations so far, so that q(z | x_o) tends to the
   posterior, whatever the proposals were.

Two kinds of proposals do that:

* ``"truncated"`` (Deistler et al. 2022, https://arxiv.org/abs/2210.04815): the prior restricted to
  the region that holds all but a fraction epsilon of the present posterior's mass. Wherever the
  posterior has mass the proposal is proportional to the prior, and plain maximum likelihood,
  max sum_n log q(z_n | x_n), needs no correction. We depart from the paper in training on the
  simulations near that region only, those of earlier rounds included: the rest says nothing about
  the posterior, and without it a flow and a regression need to describe a small neighbourhood
  only, in which the simulator is nearly linear.
* ``"atomic"`` (Greenberg et al. 2019, Eqs. 4 and 6): the present posterior itself. A row's
  parameters z_n must be told from M - 1 others of the batch,

      q~(z_n | x_n) = [q(z_n | x_n) / p(z_n)] / sum_m [q(z_m | x_n) / p(z_m)],

  with the prior p; rows from the prior also enter by plain maximum likelihood (the combined loss
  of their Appendix A.3), which ties down q where the proposals never go.

The flows are trained on preconditioned data, see :mod:`npdr_ppl.inference.features`.
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.inference.base import Backend, Density, Problem, RoundInfo, State
from npdr_ppl.inference.checks import check_problem, finite_rows
from npdr_ppl.inference.features import Preconditioner, fit_preconditioner
from npdr_ppl.inference.flows import FlowDensity, FlowNetwork, build_networks, load_member
from npdr_ppl.inference.mixture import Mixture
from npdr_ppl.inference.proposals import log_density_bound, sample_truncated_prior
from npdr_ppl.inference.training import LogProb, Loss, TrainingOptions, train

__all__ = ["SNPEC", "SNPECState", "atomic_loss"]

logger = logging.getLogger(__name__)

MIN_SIMULATIONS = 10
"""Simulations below which there is nothing to hold out and no covariance to estimate."""

FLOWS = ("nsf", "maf")
PROPOSALS = ("truncated", "atomic")


@dataclass(frozen=True)
class SNPECState(State):
    """What the next round needs.

    Attributes:
        z: Parameters of all successful simulations, ``(n, d)``.
        x: Their features, ``(n,) + observation.shape``.
        rounds: The round each came from, ``(n,)``.
        weights: The networks' parameters and buffers by name, each ``(members, ...)``; empty
            before the first round.
        preconditioner: What the networks' data are preconditioned with.
    """

    z: Tensor
    x: Tensor
    rounds: Tensor
    weights: Mapping[str, Tensor]
    preconditioner: Preconditioner | None


@dataclass(frozen=True)
class SNPEC(Backend):
    """Sequential neural posterior estimation, SNPE-C; see the module's text for the method.

    Args:
        flow: ``"nsf"``, splines, or ``"maf"``, affine maps; both autoregressive.
        transforms: Transforms of a flow.
        hidden: Widths of the hidden layers of each transform's conditioner.
        bins: Bins of a spline.
        members: Independently trained flows; the posterior is their mixture.
        proposals: ``"truncated"`` or ``"atomic"``.
        num_atoms: Atoms M of the atomic loss.
        outside: Posterior mass epsilon outside the region of truncated proposals.
        epochs: Passes through the simulations at most.
        batch_size: Rows of a mini-batch at most; fewer with few simulations.
        learning_rate: Peak of the one-cycle schedule.
        weight_decay: Decoupled weight decay.
        averaging: Decay of the running average of the weights.
        validation_fraction: Fraction of the simulations each member holds out.
        patience: Epochs without improvement after which training stops.
    """

    name: ClassVar[str] = "snpe-c"
    summary: ClassVar[str] = "sequential neural posterior estimation with normalising flows"
    amortises: ClassVar[bool] = True

    flow: Literal["nsf", "maf"] = "nsf"
    transforms: int = 2
    hidden: tuple[int, ...] = (128, 128)
    bins: int = 8
    members: int = 2
    proposals: Literal["truncated", "atomic"] = "truncated"
    num_atoms: int = 10
    outside: float = 1e-2
    epochs: int = 30
    batch_size: int = 512
    learning_rate: float = 1e-2
    weight_decay: float = 0.0
    averaging: float = 0.99
    validation_fraction: float = 0.1
    patience: int = 20

    def __post_init__(self) -> None:
        """Validates the options."""
        for option, allowed in (("flow", FLOWS), ("proposals", PROPOSALS)):
            if getattr(self, option) not in allowed:
                raise BackendError(
                    f"snpe-c: {option} must be one of {', '.join(allowed)}; "
                    f"got {getattr(self, option)!r}."
                )
        object.__setattr__(self, "hidden", tuple(self.hidden))
        positive = {"transforms", "bins", "members", "epochs", "batch_size", "patience"}
        bounds = {name: (1, float("inf")) for name in positive} | {
            "num_atoms": (2, float("inf")),
            "outside": (0.0, 0.5),
            "learning_rate": (1e-12, float("inf")),
            "weight_decay": (0.0, float("inf")),
            "averaging": (0.0, 1 - 1e-9),
            "validation_fraction": (1e-9, 0.9),
        }
        for option, (low, high) in bounds.items():
            if not low <= getattr(self, option) <= high:
                raise BackendError(
                    f"snpe-c: {option} must lie between {low} and {high}; "
                    f"got {getattr(self, option)}."
                )
        if not self.hidden or min(self.hidden) < 1:
            raise BackendError(f"snpe-c: hidden must name positive widths; got {self.hidden}.")

    def init(self, problem: Problem) -> SNPECState:
        """Returns the state before any simulation."""
        check_problem(problem)
        return SNPECState(
            round=0,
            z=torch.empty(0, problem.num_parameters),
            x=torch.empty(0, *problem.observation.shape),
            rounds=torch.empty(0, dtype=torch.long),
            weights={},
            preconditioner=None,
        )

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``."""
        state = _own(state)
        if state.round == 0:
            return problem.sample_prior(num_simulations)
        posterior = Mixture(self.densities(problem, state))
        if self.proposals == "atomic":
            return posterior.sample(num_simulations)
        with torch.no_grad():
            return sample_truncated_prior(problem, num_simulations, posterior, self.outside)

    def tell(
        self,
        problem: Problem,
        state: State,
        z: Tensor,
        x: Tensor,
        progress: Callable[[float, str], None] | None = None,
    ) -> tuple[SNPECState, RoundInfo]:
        """Trains the ensemble anew on the simulations so far; see :meth:`Backend.tell`.

        Raises:
            ShapeError: The shapes do not fit the problem.
            BackendError: Too few simulations succeeded.
        """
        start = perf_counter()
        state = _own(state)
        num_simulations = len(z)
        min_rows = MIN_SIMULATIONS if state.round == 0 else 1
        z, x, num_failed = finite_rows(problem, z.detach().cpu(), x.detach().cpu(), min_rows)
        if num_failed:
            logger.warning("%d of %d simulations failed.", num_failed, num_simulations)
        all_z, all_x = torch.cat((state.z, z)), torch.cat((state.x, x))
        rounds = torch.full((len(z),), state.round, dtype=torch.long)
        all_rounds = torch.cat((state.rounds, rounds))
        near = torch.ones(len(all_z), dtype=torch.bool)
        near[: len(state.z)] = self._near_posterior(problem, state)
        z, x, rounds = all_z[near], all_x[near], all_rounds[near]
        preconditioner = fit_preconditioner(z, x, is_raw=problem.build_network is not None)
        clipped = preconditioner.outside(problem.observation.cpu())
        if clipped.any():
            logger.warning(
                "%d of %d features of the observation lie outside the simulated range and were "
                "clipped to it: %s. The model may be wrong or its prior too narrow.",
                int(clipped.sum()),
                clipped.numel(),
                clipped.flatten().nonzero().flatten().tolist()[:10],
            )
        device = problem.device
        f = preconditioner.features(x).to(device)
        fit = train(
            self._networks(problem),
            self._loss(problem, preconditioner.to(device), z, f, rounds),
            len(z),
            TrainingOptions(
                epochs=self.epochs,
                batch_size=self.batch_size,
                learning_rate=self.learning_rate,
                weight_decay=self.weight_decay,
                averaging=self.averaging,
                validation_fraction=self.validation_fraction,
                patience=self.patience,
            ),
            device,
            is_vectorised=problem.build_network is None,
            progress=progress,
        )
        weights = {name: value.cpu() for name, value in fit.weights.items()}
        state = SNPECState(state.round + 1, all_z, all_x, all_rounds, weights, preconditioner)
        info = RoundInfo(
            num_simulations,
            num_failed,
            perf_counter() - start,
            {
                "validation_log_prob": (fit.validation.cpu() + preconditioner.log_det).tolist(),
                "best_epoch": fit.best_epochs.tolist(),
                "epochs": fit.epochs,
                "trained_on": len(z),
                "clipped_features": int(clipped.sum()),
            },
        )
        return state, info

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""
        return next(self.densities_given(problem, state, problem.observation[None]))

    def densities_given(
        self, problem: Problem, state: State, observations: Tensor
    ) -> Iterator[list[Density]]:
        """Yields the members' posteriors by observation; see :meth:`Backend.densities_given`."""
        state = _own(state)
        if state.preconditioner is None:
            raise BackendError("There is no posterior yet: tell the backend simulations first.")
        preconditioner = state.preconditioner.to(problem.device)
        build = partial(self._networks, problem)
        networks = [
            load_member(build, state.weights, k).to(problem.device) for k in range(self.members)
        ]
        for x in observations.to(problem.device, torch.float32):
            yield [FlowDensity(network, preconditioner, x) for network in networks]

    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values."""
        state = _own(state)
        tensors = {"z": state.z, "x": state.x, "rounds": state.rounds}
        tensors |= {f"weights.{name}": value for name, value in state.weights.items()}
        if state.preconditioner is not None:
            parts = state.preconditioner.tensors()
            tensors |= {f"preconditioner.{name}": value for name, value in parts.items()}
        return tensors, {"backend": self.name, "round": state.round}

    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> SNPECState:
        """Rebuilds a state from :meth:`tensors`.

        Raises:
            ShapeError: It is the state of another problem.
            BackendError: It is the state of another backend.
        """
        if values.get("backend") != self.name:
            raise BackendError(f"This state is of backend {values.get('backend')!r}, not snpe-c.")
        z, x = tensors["z"], tensors["x"]
        if z.shape[1] != problem.num_parameters or x.shape[1:] != problem.observation.shape:
            raise ShapeError(
                f"The state holds parameters {tuple(z.shape)} and features {tuple(x.shape)}; the "
                f"problem has {problem.num_parameters} parameters and features "
                f"{tuple(problem.observation.shape)}."
            )
        parts = {
            prefix: {
                name.removeprefix(f"{prefix}."): value
                for name, value in tensors.items()
                if name.startswith(f"{prefix}.")
            }
            for prefix in ("weights", "preconditioner")
        }
        fitted = parts["preconditioner"]
        return SNPECState(
            round=int(values["round"]),
            z=z,
            x=x,
            rounds=tensors["rounds"],
            weights=parts["weights"],
            preconditioner=Preconditioner.from_tensors(fitted) if fitted else None,
        )

    def _near_posterior(self, problem: Problem, state: SNPECState) -> Tensor:
        """Returns which simulations lie in the neighbourhood to train on, ``(n,)``."""
        if self.proposals == "atomic" or state.round == 0:
            return torch.ones(len(state.z), dtype=torch.bool)
        with torch.no_grad():
            posterior = Mixture(self.densities(problem, state))
            # As wide as the posterior's draws reach: the margin around the region of the
            # proposals shows a flow what lies beyond that region's edge.
            return posterior.log_prob(state.z) > log_density_bound(posterior, 0.0)

    def _networks(self, problem: Problem) -> list[FlowNetwork]:
        return build_networks(
            self.members,
            problem.num_parameters,
            problem.observation.to("cpu", torch.float32),
            problem.build_network,
            self.flow,
            self.transforms,
            self.hidden,
            self.bins,
        )

    def _loss(
        self,
        problem: Problem,
        preconditioner: Preconditioner,
        z: Tensor,
        f: Tensor,
        rounds: Tensor,
    ) -> Loss:
        """Returns the objective of the present round on the training device."""
        device = f.device
        if self.proposals == "truncated" or not rounds.any():
            u = preconditioner.whiten(z.to(device), f)
            return lambda log_prob, rows: -log_prob(u[rows], f[rows])
        return partial(
            atomic_loss,
            preconditioner.whiten(z.to(device), f),
            f,
            preconditioner.spread(z.to(device)),
            problem.log_prior(z).to(device),
            (rounds == 0).to(device),
            self.num_atoms,
        )


def atomic_loss(
    u: Tensor,
    f: Tensor,
    spread: Tensor,
    log_prior: Tensor,
    is_prior: Tensor,
    num_atoms: int,
    log_prob: LogProb,
    rows: Tensor,
) -> Tensor:
    """Returns the combined atomic loss (Greenberg et al. 2019, Eq. 6 and Appendix A.3).

        -log q~(z_n | x_n) - [n from the prior] log q(z_n | x_n)

    A row's atoms are itself and the next M - 1 rows, which are a random sample because rows come
    in random order.

    Args:
        u: Parameters whitened by their own row's regression, ``(N, d)``.
        f: Standardised features, ``(N, ...)``.
        spread: Parameters times the whitening matrix, L^-1 z, ``(N, d)``: what u differs by
            between two parameters at the same features.
        log_prior: Log density of the prior, ``(N,)``.
        is_prior: Whether a row was drawn from the prior, ``(N,)``.
        num_atoms: Atoms M.
        log_prob: Log densities of all members.
        rows: Numbers of the rows, ``(members, n)``.

    Returns:
        The loss of each row, ``(members, n)``.
    """
    num_atoms = min(num_atoms, rows.shape[1])
    atoms = torch.stack([rows.roll(-k, dims=1) for k in range(num_atoms)], dim=-1)
    u_atoms = u[rows][:, :, None] + spread[atoms] - spread[rows][:, :, None]
    log_q = log_prob(u_atoms, f[rows])
    ratio = log_q - log_prior[atoms]
    loss = ratio.logsumexp(-1) - ratio[..., 0]
    return loss - torch.where(is_prior[rows], log_q[..., 0], 0.0)


def _own(state: State) -> SNPECState:
    if not isinstance(state, SNPECState):
        raise BackendError(f"snpe-c cannot continue from a {type(state).__name__}.")
    return state
