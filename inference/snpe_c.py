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
  the region that holds all but a fraction epsilon of the present posterior's mass, where plain
  maximum likelihood, max sum_n log q(z_n | x_n), needs no correction; see
  :mod:`npdr_ppl.inference.truncated`.
* ``"atomic"`` (Greenberg et al. 2019, Eqs. 4 and 6): the present posterior itself. A row's
  parameters z_n must be told from M - 1 others of the batch,

      q~(z_n | x_n) = [q(z_n | x_n) / p(z_n)] / sum_m [q(z_m | x_n) / p(z_m)],

  with the prior p; rows from the prior also enter by plain maximum likelihood (the combined loss
  of their Appendix A.3), which ties down q where the proposals never go.

The flows are trained on preconditioned data, see :mod:`npdr_ppl.inference.features`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.features import Preconditioner
from npdr_ppl.inference.flows import (
    FLOWS,
    Flow,
    FlowDensity,
    FlowNetwork,
    build_networks,
    load_member,
)
from npdr_ppl.inference.mixture import Mixture
from npdr_ppl.inference.neural import NeuralBackend, NeuralState, Simulations
from npdr_ppl.inference.training import LogProb, Loss
from npdr_ppl.inference.truncated import TruncatedBackend

__all__ = ["SNPEC", "atomic_loss"]

PROPOSALS = ("truncated", "atomic")


@dataclass(frozen=True)
class SNPEC(TruncatedBackend):
    """Sequential neural posterior estimation, SNPE-C; see the module's text for the method.

    Args:
        flow: Kind of flow, see :class:`~npdr_ppl.inference.flows.FlowNetwork`.
        transforms: Transforms of a flow.
        hidden: Widths of the hidden layers of each transform's conditioner.
        bins: Bins of a spline.
        proposals: ``"truncated"`` or ``"atomic"``.
        num_atoms: Atoms M of the atomic loss.

    The other options are those of :class:`~npdr_ppl.inference.truncated.TruncatedBackend`.
    """

    name: ClassVar[str] = "snpe-c"
    summary: ClassVar[str] = "sequential neural posterior estimation with normalising flows"
    amortises: ClassVar[bool] = True

    flow: Flow = "nsf"
    transforms: int = 2
    hidden: tuple[int, ...] = (128, 128)
    bins: int = 8
    proposals: Literal["truncated", "atomic"] = "truncated"
    num_atoms: int = 10

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_choice("flow", FLOWS)
        self._check_choice("proposals", PROPOSALS)
        self._check_widths("hidden")
        self._check_ranges(
            transforms=(1, float("inf")),
            bins=(1, float("inf")),
            num_atoms=(2, float("inf")),
        )

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
        build = partial(self._networks, problem)
        networks = [
            load_member(build, state.weights, k).to(problem.device) for k in range(self.members)
        ]
        for x in observations.to(problem.device, torch.float32):
            yield [FlowDensity(network, preconditioner, x) for network in networks]

    def _training_rows(self, problem: Problem, state: NeuralState) -> Tensor:
        """Returns which simulations to train on, ``(n,)``; the atomic loss corrects for all."""
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

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective of the present round on the training device."""
        z, f = simulations.z.to(problem.device), simulations.x.to(problem.device)
        f = preconditioner.features(f)
        u = preconditioner.whiten(z, f)
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
