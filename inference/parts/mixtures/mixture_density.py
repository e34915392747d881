"""Mixture density networks (Bishop 1994) with full covariances.

They act on preconditioned data, see :mod:`npdr_ppl.inference.parts.training.preconditioning`, and
start close to the standard normal, that is, to the preconditioner's linear-Gaussian posterior.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture, triangular_factors
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = ["MixtureDensityNetwork", "mixture_at", "perceptron"]

INITIAL_SCALE = 0.01
"""Factor on the head's initial weights, so that features have little effect before training."""

INITIAL_SPREAD = 0.3
"""Standard deviation of the components' initial means, in standard deviations of the whole
mixture. Equal components would receive equal gradients and stay equal."""

LOG_SCALE_LIMIT = 7.0
"""Maximum absolute logarithm of a precision factor's diagonal elements: the widths of components
lie between 0.001 and 1000 times the linear regression's residuals."""


class MixtureParameters(NamedTuple):
    """Mixtures of n rows; the rows are the last dimension.

    The many small operations on matrices then run along contiguous memory.

    Attributes:
        log_weights: Log weights log w_k, ``(K, n)``.
        log_scales: Log diagonals of U_k, ``(d, K, n)``.
        shifts: Whitened means v_k, ``(d, K, n)``.
        upper: Elements of U_k above the diagonal, row by row, ``(d (d - 1) / 2, K, n)``.
    """

    log_weights: Tensor
    log_scales: Tensor
    shifts: Tensor
    upper: Tensor


class MixtureDensityNetwork(nn.Module):
    """A conditional mixture of Gaussians in the whitened parameters u.

        q(u | f) = sum_k w_k N(u; U_k^-1 v_k, (U_k^T U_k)^-1),

    whose log weights w_k, upper triangular precision factors U_k and whitened means v_k are
    linear in a hidden layer h(f).

    Where a row's parameters came from a proposal, the network is evaluated as the proposal
    posterior q(u | f) t(u) / Z(f), see
    :mod:`npdr_ppl.inference.parts.mixtures.proposal_correction`.

    Args:
        num_parameters: Dimension d of u.
        num_hidden: Length of h(f).
        components: Number of components K.
        hidden: Network h, without the embedding.
        embedding: Embedding network, or ``None`` for final features.
    """

    def __init__(
        self,
        num_parameters: int,
        num_hidden: int,
        components: int,
        hidden: nn.Module,
        embedding: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.num_parameters, self.components = num_parameters, components
        self.embedding, self.hidden = embedding, hidden
        num_upper = num_parameters * (num_parameters - 1) // 2
        self.sizes = [components * n for n in (1, num_parameters, num_parameters, num_upper)]
        self.head = nn.Linear(num_hidden, sum(self.sizes))
        with torch.no_grad():
            self.head.weight.mul_(INITIAL_SCALE)
            self.head.bias.zero_()
            if components > 1:
                _, log_scales, shifts, _ = self.head.bias.split(self.sizes)
                # Narrower components compensate for the spread of their means.
                log_scales.fill_(-0.5 * math.log(1 - INITIAL_SPREAD**2))
                shifts.copy_(INITIAL_SPREAD * torch.randn_like(shifts))

    def parameters_at(self, f: Tensor) -> MixtureParameters:
        """Returns the mixtures at standardised features ``(n, ...)``."""
        h = self.hidden(f if self.embedding is None else self.embedding(f))
        raw = self.head.weight @ h.mT + self.head.bias[:, None]
        parts = [part.view(-1, self.components, len(h)) for part in raw.split(self.sizes)]
        log_scales = parts[1] / (1 + parts[1].abs() / LOG_SCALE_LIMIT)
        return MixtureParameters(parts[0][0].log_softmax(0), log_scales, parts[2], parts[3])

    def forward(self, u: Tensor, f: Tensor) -> Tensor:
        """Returns log q(u | f), or that of the proposal posterior, ``(n,)``.

        Args:
            u: Whitened parameters, ``(n, d)``; those drawn from a proposal are followed by the
                quadratic forms of its tilt at the same row, ``(n, d + J (d + 1)^2)``.
            f: Standardised features, ``(n, ...)``.
        """
        d = self.num_parameters
        mixtures = self.parameters_at(f)
        scales = mixtures.log_scales.exp()
        log_volume = mixtures.log_weights + mixtures.log_scales.sum(0)
        point = u[:, :d].mT
        white = scales * point[:, None] - mixtures.shifts
        if d > 1:
            row, column = torch.triu_indices(d, d, offset=1, device=u.device)
            products = mixtures.upper * point[column][:, None]
            in_row = (row == torch.arange(d, device=u.device)[:, None]).to(u)
            white = white + (in_row @ products.flatten(1)).view(white.shape)
        log_q = (log_volume - 0.5 * white.square().sum(0)).logsumexp(0)
        log_q = log_q - 0.5 * d * math.log(2 * math.pi)
        if u.shape[1] == d:
            return log_q
        point = torch.cat((point, torch.ones_like(point[:1])))
        forms = u[:, d:].mT.reshape(-1, d + 1, d + 1, len(u)).permute(1, 2, 0, 3)
        exponent = ((forms * point[:, None, None]).sum(0) * point[:, None]).sum(0)
        log_tilt = (-0.5 * exponent).logsumexp(0)
        rows = _factor_rows(scales, mixtures)
        log_normaliser = log_volume[None] + _log_integral(forms[:, :, :, None], rows)
        return log_q + log_tilt - log_normaliser.flatten(0, 1).logsumexp(0)


def _factor_rows(scales: Tensor, mixtures: MixtureParameters) -> list[Tensor]:
    """Returns the rows of [U, -v] from the diagonal on, each ``(d - i + 1, K, n)``."""
    d = len(scales)
    upper = mixtures.upper.split([d - 1 - i for i in range(d)])
    return [
        torch.cat((scales[i : i + 1], upper[i], -mixtures.shifts[i : i + 1])) for i in range(d)
    ]


def _log_integral(forms: Tensor, rows: list[Tensor]) -> Tensor:
    """Integrates Gaussians times exponentials of quadratic forms by Gaussian elimination.

    Eliminates one parameter after another from the sum of a form and [U, -v]^T [U, -v]. Row i of
    the latter is added just before parameter i is eliminated, because its earlier entries are
    zero.

    Args:
        forms: Quadratic forms, ``(d + 1, d + 1, J, 1, n)``.
        rows: Rows of [U, -v] from the diagonal on, each ``(d - i + 1, K, n)``.

    Returns:
        log int exp(-1/2 (u, 1)^T (form + [U, -v]^T [U, -v]) (u, 1)) du / (2 pi)^(d / 2),
        ``(J, K, n)``.
    """
    pivots = []
    left = forms
    for row in rows:
        first = left[0] + (row[0] * row)[:, None]
        # Not below the square of U's diagonal except for rounding: the form is nonnegative.
        pivot = torch.maximum(first[0], (row[0] ** 2)[None])
        column = first[1:]
        fresh = (row[1:, None] * row[None, 1:])[:, :, None]
        left = left[1:, 1:] + fresh - column[:, None] * (column / pivot)[None]
        pivots.append(pivot)
    return -0.5 * (torch.stack(pivots).log().sum(0) + left[0, 0])


def perceptron(
    num_features: int, widths: tuple[int, ...], activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Returns fully connected layers of given widths, each with its activation."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(num_features, width), activation()]
        num_features = width
    return nn.Sequential(*layers)


def mixture_at(
    network: MixtureDensityNetwork, preconditioner: Preconditioner, observation: Tensor
) -> GaussianMixture:
    """Returns a trained network's posterior given an observation, in reference coordinates.

    Args:
        network: The network.
        preconditioner: The preconditioner fitted before training, on the same device.
        observation: Observation x_o, ``(F,)`` or a raw array, on the same device.
    """
    d = network.num_parameters
    features = preconditioner.features(observation[None])
    with torch.no_grad():
        mixtures = network.parameters_at(features)
        rows = _factor_rows(mixtures.log_scales.exp(), mixtures)
    joint = torch.zeros(network.components, d, d + 1, dtype=torch.float64)
    for i, row in enumerate(rows):
        joint[:, i, i:] = row[..., 0].mT.cpu().double()
    factors, whitened = joint[..., :-1], -joint[..., -1:]
    means = torch.linalg.solve_triangular(factors, whitened, upper=True)[..., 0]
    scale = preconditioner.factor.cpu().double()
    shift = preconditioner.shift(features)[0].cpu().double()
    roots = torch.linalg.solve_triangular(scale, factors, upper=False, left=False)
    return GaussianMixture(
        mixtures.log_weights[:, 0].cpu(), means @ scale.T + shift, triangular_factors(roots)
    )
