"""NRE: neural ratio estimation, contrastive and sequential.

Hermans, Begy & Louppe (2020), https://arxiv.org/abs/1903.04057, as generalised by Miller, Weniger
& Forre (2022), *Contrastive Neural Ratio Estimation*, https://arxiv.org/abs/2210.06170: a
classifier h(z, x) decides which of K parameters, if any, a simulation x came from. With the
parameters z_1 ... z_K of K rows, and g = gamma / K, it minimises (their Eqs. 8 and 9)

    -1 / (1 + gamma)  E log [ 1 / (1 + g sum_k exp h(z_k, x)) ]        all z_k independent of x
    -gamma / (1 + gamma)  E log [ g exp h(z_1, x) / (1 + g sum_k exp h(z_k, x)) ]    z_1 x's own

whose optimum is h(z, x) = log p(x | z) - log p~(x), where p~ is the marginal under the proposals
of the parameters. In every round this is a log likelihood up to a function of x (Durkan, Murray &
Papamakarios 2020).

We depart from the paper in the form of the classifier,

    h(z, x) = log N(z; A f + b, L L^T) / N(z; m, S) + a(z)^T b(f) + c(z) + w^T [r(z) + s(f)]_+.

The first term is the ratio of a linear-Gaussian model, from which training starts. The networks a
and b enter by their inner product, the form of the likelihood of any exponential family. The
networks r and s enter by ridge functions of their sum, the form that a likelihood of x - g(z)
needs. With these forms, evaluating all pairs of a mini-batch costs little more than the matching
pairs. Each simulation is therefore compared with a hundred parameters instead of a few.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn

from npdr_ppl.inference.base import Problem, State
from npdr_ppl.inference.parts.bases.likelihood_backend import (
    LearnedLogLikelihood,
    LikelihoodBackend,
)
from npdr_ppl.inference.parts.bases.neural_backend import Simulations
from npdr_ppl.inference.parts.mixtures.mixture_density import perceptron
from npdr_ppl.inference.parts.training.ensemble_training import LogProb, Loss
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, fit_preconditioner

__all__ = ["NRE", "RatioNetwork", "RatioPreconditioner", "contrastive_loss"]


@dataclass(frozen=True)
class RatioPreconditioner(Preconditioner):
    """The preconditioner of parameters given features, and of parameters alone.

    Attributes:
        marginal_mean: Mean of the simulated parameters, ``(d,)``.
        marginal_factor: Cholesky factor of their covariance, ``(d, d)``.
    """

    marginal_mean: Tensor
    marginal_factor: Tensor

    def standardise(self, z: Tensor) -> Tensor:
        """Returns parameters ``(n, d)`` with mean zero and unit covariance."""
        centred = (z - self.marginal_mean).T
        return torch.linalg.solve_triangular(self.marginal_factor, centred, upper=False).T

    def log_ratio(self, v: Tensor, u: Tensor) -> Tensor:
        """Returns the ratio of the linear-Gaussian model, log N(z; A f + b) - log N(z; mean).

        Args:
            v: Standardised parameters, ``(..., d)``.
            u: Whitened residuals, ``(..., d)``.
        """
        scale = self.marginal_factor.diagonal().log().sum() + self.log_det
        return scale + 0.5 * (v.square() - u.square()).sum(-1)


class RatioNetwork(nn.Module):
    """The correction to the linear-Gaussian ratio, which starts at zero.

    Args:
        num_parameters: Dimension d.
        num_features: Number of features F.
        hidden: Widths of the hidden layers of the two networks.
        rank: Length of a and b.
        units: Length of r and s.
    """

    def __init__(
        self,
        num_parameters: int,
        num_features: int,
        hidden: tuple[int, ...],
        rank: int,
        units: int,
    ) -> None:
        super().__init__()
        self.rank = rank
        self.of_parameters = _perceptron(num_parameters, hidden, rank + units + 1)
        self.of_features = _perceptron(num_features, hidden, rank + units)
        self.weights = nn.Parameter(torch.zeros(units))
        last = self.of_parameters[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            for rows in (slice(rank), slice(-1, None)):
                last.weight[rows].zero_()
                last.bias[rows].zero_()

    def forward(self, v: Tensor, f: Tensor) -> Tensor:
        """Returns the correction of all pairs, ``(..., n, k)``.

        Args:
            v: Standardised parameters, ``(..., k, d)``.
            f: Standardised features, ``(..., n, F)``.
        """
        of_v, of_f = self.of_parameters(v), self.of_features(f)
        a, r, c = of_v.split((self.rank, len(self.weights), 1), dim=-1)
        b, s = of_f.split((self.rank, len(self.weights)), dim=-1)
        product = b @ a.transpose(-1, -2) + c.transpose(-1, -2)
        return product + (r[..., None, :, :] + s[..., :, None, :]).relu() @ self.weights


def _perceptron(num_inputs: int, hidden: tuple[int, ...], num_outputs: int) -> nn.Sequential:
    return perceptron(num_inputs, hidden, nn.SiLU).append(nn.Linear(hidden[-1], num_outputs))


@dataclass(frozen=True)
class NRE(LikelihoodBackend):
    """Neural ratio estimation; see the module's text for the method.

    Args:
        hidden: Widths of the hidden layers of both networks.
        rank: Length of their inner product.
        units: Number of units applied to the sum of their outputs.
        num_atoms: Number of parameters K with which a simulation is compared.
        gamma: Odds that the right one is among them.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.neural_backend.NeuralBackend`.
    """

    name: ClassVar[str] = "nre"
    summary: ClassVar[str] = "contrastive neural ratio estimation, many features, any prior later"
    objective: ClassVar[str] = "validation_contrast"
    preconditioner_type: ClassVar[type[Preconditioner]] = RatioPreconditioner

    members: int = 1
    epochs: int = 40
    batch_size: int = 256
    hidden: tuple[int, ...] = (128, 128, 128)
    rank: int = 16
    units: int = 32
    num_atoms: int = 127
    gamma: float = 50.0

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_widths("hidden")
        self._check_at_least(1, "rank", "units")
        self._check_at_least(2, "num_atoms")
        self._check_at_least(1e-9, "gamma")

    def log_likelihoods(self, problem: Problem, state: State) -> list[LearnedLogLikelihood]:
        """Returns h(z, x) of every ensemble member."""
        state, fitted = self._trained(state)
        assert isinstance(fitted, RatioPreconditioner)
        preconditioner = fitted.to(problem.device)

        def log_likelihood(network: RatioNetwork, z: Tensor, x: Tensor) -> Tensor:
            f = preconditioner.features(x.to(problem.device))
            points = z.to(problem.device, torch.float32)
            v, u = preconditioner.standardise(points), preconditioner.whiten(points, f)
            correction = network(v[:, None], f[:, None])[:, 0, 0]
            return (preconditioner.log_ratio(v, u) + correction).to(z)

        networks = self._trained_networks(problem, state.weights)
        return [partial(log_likelihood, network) for network in networks]

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        conditional = fit_preconditioner(simulations.z, simulations.x)
        marginal = fit_preconditioner(simulations.z, simulations.x[:, :0])
        return RatioPreconditioner(
            **conditional.tensors(),
            marginal_mean=simulations.z.mean(0),
            marginal_factor=marginal.factor,
        )

    def _objective(self, validation: Tensor, preconditioner: Preconditioner) -> Tensor:
        return validation

    def _networks(self, problem: Problem) -> list[RatioNetwork]:
        num_features = problem.observation.numel()
        return [
            RatioNetwork(problem.num_parameters, num_features, self.hidden, self.rank, self.units)
            for _ in range(self.members)
        ]

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        assert isinstance(preconditioner, RatioPreconditioner)
        z = simulations.z.to(problem.device)
        f = preconditioner.features(simulations.x.to(problem.device))
        return partial(
            contrastive_loss,
            preconditioner.standardise(z),
            preconditioner.whiten(z, f),
            preconditioner.spread(z),
            f,
            preconditioner.log_ratio,
            self.num_atoms,
            self.gamma,
        )


def contrastive_loss(
    v: Tensor,
    u: Tensor,
    spread: Tensor,
    f: Tensor,
    log_ratio: Callable[[Tensor, Tensor], Tensor],
    num_atoms: int,
    gamma: float,
    correction: LogProb,
    rows: Tensor,
) -> Tensor:
    """Returns the loss of Miller et al. (2022, Eqs. 8 and 9) for each row.

    Rows come in random order and are split into groups of K + 1. A row's K independent parameters
    are those of the other rows of its group. In the second term the row's own parameters replace
    one of them.

    Args:
        v: Standardised parameters, ``(N, d)``.
        u: Parameters whitened by their own row's regression, ``(N, d)``.
        spread: Parameters times the whitening matrix, ``(N, d)``.
        f: Standardised features, ``(N, F)``.
        log_ratio: The linear-Gaussian part of h, from v and u.
        num_atoms: Maximum number of parameters K.
        gamma: Odds that the row's own are among them.
        correction: The networks' part of h, of all members and pairs.
        rows: Indices of the rows, ``(members, n)``.

    Returns:
        The loss, ``(members, n)``.
    """
    n = rows.shape[1]
    size = min(num_atoms + 1, n)
    starts = list(range(0, n - size + 1, size))
    losses = [
        _group_loss(v, u, spread, f, log_ratio, gamma, correction, rows[:, start : start + size])
        for start in starts
    ]
    rest = n - len(starts) * size
    if rest:  # grouped with rows of the last group
        last = _group_loss(v, u, spread, f, log_ratio, gamma, correction, rows[:, n - size :])
        losses.append(last[:, size - rest :])
    return torch.cat(losses, dim=1)


def _group_loss(
    v: Tensor,
    u: Tensor,
    spread: Tensor,
    f: Tensor,
    log_ratio: Callable[[Tensor, Tensor], Tensor],
    gamma: float,
    correction: LogProb,
    rows: Tensor,
) -> Tensor:
    """Returns the loss of the rows of a group, ``(members, K + 1)``."""
    size = rows.shape[1]
    # Pairs (i, j): features of row i, parameters of row j.
    own, other = spread[rows][:, :, None], spread[rows][:, None]
    h = log_ratio(v[rows][:, None], u[rows][:, :, None] + other - own)
    h = h + correction(v[rows], f[rows])
    log_odds = math.log(gamma / (size - 1))
    itself = torch.eye(size, dtype=torch.bool, device=rows.device)
    # The row's own parameters replace those of the next row.
    replaced = itself.roll(1, dims=1)
    independent = h.masked_fill(itself, -torch.inf).logsumexp(-1)
    joint = h.masked_fill(replaced, -torch.inf).logsumexp(-1)
    right = h.diagonal(dim1=-2, dim2=-1)
    softplus = torch.nn.functional.softplus
    wrong = softplus(log_odds + independent)
    return (wrong + gamma * (softplus(log_odds + joint) - log_odds - right)) / (1 + gamma)
