"""NRE: neural ratio estimation, contrastive and sequential.

Hermans, Begy & Louppe (2020), https://arxiv.org/abs/1903.04057, as generalised by Miller, Weniger
& Forre (2022), *Contrastive Neural Ratio Estimation*, https://arxiv.org/abs/2210.06170: a
classifier h(z, x) is asked which of K parameters, if any, a simulation x came from. With the
parameters z_1 ... z_K of K rows, and g = gamma / K, it minimises (their Eqs. 8 and 9)

    -1 / (1 + gamma)  E log [ 1 / (1 + g sum_k exp h(z_k, x)) ]        all z_k independent of x
    -gamma / (1 + gamma)  E log [ g exp h(z_1, x) / (1 + g sum_k exp h(z_k, x)) ]    z_1 x's own

whose optimum is h(z, x) = log p(x | z) - log p~(x), with p~ the marginal under whatever proposals
the parameters came from: a likelihood up to a function of x, in every round (Durkan, Murray &
Papamakarios 2020).

We depart from the paper in starting at a closed form: h is the ratio of a linear-Gaussian model of
parameters and features, plus a network that starts at zero.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn

from npdr_ppl.inference.base import Problem, State
from npdr_ppl.inference.features import Preconditioner, fit_preconditioner
from npdr_ppl.inference.likelihood import LearnedLogLikelihood, LikelihoodBackend
from npdr_ppl.inference.neural import NeuralState, Simulations
from npdr_ppl.inference.training import LogProb, Loss
from npdr_ppl.randomness import seeded

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
    """The correction to the linear-Gaussian ratio: a residual network that starts at zero.

    Args:
        num_parameters: Dimension d.
        num_features: Number of features F.
        width: Width of the hidden layers.
        blocks: Residual blocks of two layers.
    """

    def __init__(self, num_parameters: int, num_features: int, width: int, blocks: int) -> None:
        super().__init__()
        self.first = nn.Linear(2 * num_parameters + num_features, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(blocks)
        )
        self.last = nn.Linear(width, 1)
        with torch.no_grad():
            self.last.weight.zero_()
            self.last.bias.zero_()

    def forward(self, vu: Tensor, f: Tensor) -> Tensor:
        """Returns the correction in the leading shape of ``vu``.

        Args:
            vu: Standardised parameters and whitened residuals, ``(n, 2 d)`` or ``(n, K, 2 d)``.
            f: Standardised features, ``(n, F)``.
        """
        # What depends on the features only is computed once for all K parameters of a row.
        from_f = f @ self.first.weight[:, vu.shape[-1] :].T + self.first.bias
        if vu.ndim == 3:
            from_f = from_f[:, None]
        hidden = from_f + vu @ self.first.weight[:, : vu.shape[-1]].T
        for block in self.blocks:
            hidden = hidden + block(hidden)
        return self.last(hidden)[..., 0]


@dataclass(frozen=True)
class NRE(LikelihoodBackend):
    """Neural ratio estimation; see the module's text for the method.

    Args:
        width: Width of the classifier's hidden layers.
        blocks: Its residual blocks.
        num_atoms: Parameters K that a simulation is shown.
        gamma: Odds of the right one being among them.

    The other options are those of :class:`~npdr_ppl.inference.neural.NeuralBackend`.
    """

    name: ClassVar[str] = "nre"
    summary: ClassVar[str] = "contrastive neural ratio estimation, many features, any prior later"
    objective: ClassVar[str] = "validation_contrast"
    preconditioner_type: ClassVar[type[Preconditioner]] = RatioPreconditioner

    members: int = 1
    width: int = 64
    blocks: int = 2
    num_atoms: int = 5
    gamma: float = 1.0
    learning_rate: float = 5e-3
    batch_size: int = 256

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_ranges(
            width=(1, float("inf")),
            blocks=(0, float("inf")),
            num_atoms=(1, float("inf")),
            gamma=(1e-9, float("inf")),
        )

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation.

        Raises:
            BackendError: The features are learnt jointly.
        """
        self._check_fixed_features(problem)
        return super().init(problem)

    def log_likelihoods(self, problem: Problem, state: State) -> list[LearnedLogLikelihood]:
        """Returns h(z, x) of every ensemble member."""
        state, fitted = self._trained(state)
        assert isinstance(fitted, RatioPreconditioner)
        preconditioner = fitted.to(problem.device)

        def log_likelihood(network: RatioNetwork, z: Tensor, x: Tensor) -> Tensor:
            f = preconditioner.features(x.to(problem.device))
            points = z.to(problem.device, torch.float32)
            v, u = preconditioner.standardise(points), preconditioner.whiten(points, f)
            correction = network(torch.cat((v, u), -1), f)
            return (preconditioner.log_ratio(v, u) + correction).to(z)

        members = []
        for k in range(self.members):
            with seeded(0, "untrained networks"):  # the caller's stream must not notice
                network = self._networks(problem)[k]
            network.load_state_dict({name: value[k] for name, value in state.weights.items()})
            network = network.to(problem.device).requires_grad_(False).eval()
            members.append(partial(log_likelihood, network))
        return members

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
            RatioNetwork(problem.num_parameters, num_features, self.width, self.blocks)
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

    A row's K independent parameters are those of the next K rows, which are a random sample
    because rows come in random order; for the second term the row's own take the first one's
    place.

    Args:
        v: Standardised parameters, ``(N, d)``.
        u: Parameters whitened by their own row's regression, ``(N, d)``.
        spread: Parameters times the whitening matrix, ``(N, d)``.
        f: Standardised features, ``(N, F)``.
        log_ratio: The linear-Gaussian part of h, from v and u.
        num_atoms: Parameters K.
        gamma: Odds of the row's own being among them.
        correction: The networks' part of h, of all members.
        rows: Numbers of the rows, ``(members, n)``.

    Returns:
        The loss, ``(members, n)``.
    """
    num_atoms = min(num_atoms, rows.shape[1] - 1)
    atoms = torch.stack([rows.roll(-k, dims=1) for k in range(num_atoms + 1)], dim=-1)
    u_atoms = u[rows][:, :, None] + spread[atoms] - spread[rows][:, :, None]
    v_atoms = v[atoms]
    h = log_ratio(v_atoms, u_atoms) + correction(torch.cat((v_atoms, u_atoms), -1), f[rows])
    log_odds = math.log(gamma / num_atoms)
    independent = torch.nn.functional.softplus(log_odds + h[..., 1:].logsumexp(-1))
    joint = h[..., :-1]  # the row's own and K - 1 of the others
    right = torch.nn.functional.softplus(log_odds + joint.logsumexp(-1)) - log_odds - h[..., 0]
    return (independent + gamma * right) / (1 + gamma)
