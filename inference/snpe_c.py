"""SNPE-C: sequential neural posterior estimation with normalising flows.

Greenberg, Nonnenmacher & Macke (2019), *Automatic Posterior Transformation for Likelihood-Free
Inference*, https://arxiv.org/abs/1905.07488; it continues Papamakarios & Murray (2016) and
Lueckmann et al. (2017). Each round r of Algorithm 1

1. draws parameters z_n from a proposal p_r(z), the prior in the first round,
2. simulates features x_n ~ p(x | z_n),
3. trains a conditional flow q(z | x) on the simulations so far, so that q(z | x_o) tends to the
   posterior for all proposals.

Two kinds of proposals have this property:

* ``"truncated"`` (Deistler et al. 2022, https://arxiv.org/abs/2210.04815): the prior restricted to
  the region that holds all but a fraction epsilon of the current posterior's mass. In it plain
  maximum likelihood, max sum_n log q(z_n | x_n), needs no correction; see
  :mod:`npdr_ppl.inference.parts.bases.truncated`.
* ``"atomic"`` (Greenberg et al. 2019, Eqs. 4 and 6): the current posterior itself. The network
  must identify a row's parameters z_n among M - 1 others of the batch,

      q~(z_n | x_n) = [q(z_n | x_n) / p(z_n)] / sum_m [q(z_m | x_n) / p(z_m)],

  with the prior p; rows from the prior also enter by plain maximum likelihood (the combined loss
  of their Appendix A.3). This determines q where no proposal was drawn.

The flows are trained on preconditioned data
(:mod:`npdr_ppl.inference.parts.training.preconditioning`), all members in one pass
(:mod:`npdr_ppl.inference.parts.flows.stacked_flow`). All members hold out the same simulations.
Their common base density is fitted to these afterwards
(:mod:`npdr_ppl.inference.parts.flows.flow_base`).

By default a flow begins with an affine map, because the width of the posterior may depend strongly
on the features. With a uniform prior, z is Phi^-1 of the parameter's position in its range, and a
given width of the position is 15 times wider in z at 99 % of the range than at its centre.
Preconditioning scales by one width for all features. Splines act only within five of these widths,
so that they alone cannot represent the posterior near the end of a range.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.parts.bases.neural_backend import (
    NeuralBackend,
    NeuralState,
    Simulations,
)
from npdr_ppl.inference.parts.bases.truncated import TruncatedBackend
from npdr_ppl.inference.parts.flows.flow_base import FlowBase, fit_base
from npdr_ppl.inference.parts.flows.flows import (
    FLOWS,
    Flow,
    FlowDensity,
    FlowNetwork,
    build_networks,
)
from npdr_ppl.inference.parts.flows.stacked_flow import stacked_log_prob
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.training.ensemble_training import Evaluator, LogProb, Loss
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, whiten_unseen

__all__ = ["SNPEC", "atomic_loss"]

PROPOSALS = ("truncated", "atomic")

SCALE, FREEDOM = "base.scale", "base.freedom"
"""Names under which the parameters of the flows' base density are stored with the weights."""

MIN_HELD_OUT = 20
"""Minimum number of held-out simulations to fit the flows' base density."""


@dataclass(frozen=True)
class SNPEC(TruncatedBackend):
    """Sequential neural posterior estimation, SNPE-C; see the module's text for the method.

    Args:
        flow: Kind of flow, see :class:`~npdr_ppl.inference.parts.flows.flows.FlowNetwork`.
        transforms: Number of transforms of a flow; with ``"affine-nsf"``, the affine map is one.
        hidden: Widths of the hidden layers of each transform's conditioner.
        bins: Number of bins of a spline.
        proposals: ``"truncated"`` or ``"atomic"``.
        num_atoms: Number of atoms M of the atomic loss.
        calibrates: Whether the flows' base density is fitted to the held-out simulations, see
            :mod:`npdr_ppl.inference.parts.flows.flow_base`.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.truncated.TruncatedBackend`.
    """

    name: ClassVar[str] = "snpe-c"
    summary: ClassVar[str] = "sequential neural posterior estimation with normalising flows"
    amortises: ClassVar[bool] = True
    shares_held_out: ClassVar[bool] = True

    members: int = 3
    epochs: int = 24
    batch_size: int = 256
    flow: Flow = "affine-nsf"
    transforms: int = 3
    hidden: tuple[int, ...] = (96, 96)
    bins: int = 8
    proposals: Literal["truncated", "atomic"] = "truncated"
    num_atoms: int = 10
    calibrates: bool = True

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_choice("flow", FLOWS)
        self._check_choice("proposals", PROPOSALS)
        self._check_widths("hidden")
        self._check_at_least(1, "transforms", "bins")
        self._check_at_least(2, "num_atoms")

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``."""
        if self.proposals == "atomic" and state.round > 0:
            return Mixture(self.densities(problem, state)).sample(num_simulations)
        return super().ask(problem, state, num_simulations)

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""
        return next(self.densities_given(problem, state, problem.observation[None]))

    def densities_given(
        self, problem: Problem, state: State, observations: Tensor
    ) -> Iterator[list[Density]]:
        """Yields the members' posteriors by observation; see :meth:`Backend.densities_given`."""
        state, preconditioner = self._trained(state)
        preconditioner = preconditioner.to(problem.device)
        networks = self._trained_networks(problem, state.weights)
        base = FlowBase()
        if SCALE in state.weights:
            base = FlowBase(float(state.weights[SCALE][0]), float(state.weights[FREEDOM][0]))
        for x in observations.to(problem.device, torch.float32):
            yield [FlowDensity(network, preconditioner, x, base) for network in networks]

    def _training_rows(self, problem: Problem, state: NeuralState) -> Tensor:
        """Returns which simulations to train on, ``(n,)``; the atomic loss can use all."""
        if self.proposals == "atomic":
            return NeuralBackend._training_rows(self, problem, state)
        return super()._training_rows(problem, state)

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

    def _evaluator(self, problem: Problem) -> Evaluator:
        """Returns the joint evaluation of all networks, which is faster than torch's own."""
        return super()._evaluator(problem) if problem.build_network else stacked_log_prob

    def _training_data(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> tuple[Tensor, Tensor]:
        """Returns whitened parameters ``(n, d)`` and standardised features on the device."""
        x = simulations.x.to(problem.device)
        return whiten_unseen(preconditioner, simulations.z.to(problem.device), x)

    def _calibration(
        self,
        problem: Problem,
        preconditioner: Preconditioner,
        simulations: Simulations,
        weights: Mapping[str, Tensor],
        held_out: Tensor,
    ) -> dict[str, Tensor]:
        """Fits the flows' base density to the held-out simulations (atomic: those from the prior).

        With the atomic loss, simulations from later proposals do not follow the posterior's
        density and cannot be used for the fit.
        """
        numbers = held_out[0]
        if self.proposals == "atomic":
            numbers = numbers[simulations.rounds[numbers] == 0]
        if not self.calibrates or len(numbers) < MIN_HELD_OUT:
            return {}
        u, f = self._training_data(problem, preconditioner.to(problem.device), simulations)
        u, f = u[numbers.to(u.device)], f[numbers.to(f.device)]
        squares, log_dets = [], []
        for network in self._trained_networks(problem, weights):
            with torch.no_grad():
                base, log_det = network.transform(network.context(f)).call_and_ladj(u)
            squares.append((base**2).sum(-1))
            log_dets.append(log_det)
        fitted = fit_base(torch.stack(squares), torch.stack(log_dets), u.shape[1])
        # The first dimension is the members, as in all weights; all members have the same base.
        values = {SCALE: fitted.scale, FREEDOM: fitted.freedom}
        return {
            name: torch.full((self.members,), value, dtype=torch.float64)
            for name, value in values.items()
        }

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective of the current round on the training device."""
        z = simulations.z.to(problem.device)
        u, f = self._training_data(problem, preconditioner, simulations)
        if self.proposals == "truncated" or not simulations.rounds.any():
            return lambda log_prob, rows: -log_prob(u[rows], f[rows])
        return partial(
            atomic_loss,
            u,
            f,
            preconditioner.spread(z),
            problem.log_prior(simulations.z).to(problem.device),
            (simulations.rounds == 0).to(problem.device),
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
        spread: Parameters times the whitening matrix, L^-1 z, ``(N, d)``. At the same features,
            the values of u of two parameters differ by the difference of these.
        log_prior: Log density of the prior, ``(N,)``.
        is_prior: Whether a row was drawn from the prior, ``(N,)``.
        num_atoms: Atoms M.
        log_prob: Log densities of all members.
        rows: Indices of the rows, ``(members, n)``.

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
