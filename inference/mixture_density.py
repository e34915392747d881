"""Mixture density networks (Bishop 1994) with full covariances.

They act on preconditioned data, see :mod:`npdr_ppl.inference.features`, and start close to the
standard normal, that is, to the preconditioner's linear-Gaussian posterior.
"""

import math

import torch
from torch import Tensor, nn

from npdr_ppl.inference.features import Preconditioner
from npdr_ppl.inference.gaussian_mixture import GaussianMixture, triangular_factors

__all__ = ["MixtureDensityNetwork", "mixture_at", "perceptron"]

INITIAL_SCALE = 0.01
"""Factor on the head's initial weights, so that features hardly matter before training."""

INITIAL_SPREAD = 0.05
"""Root mean square of the components' initial means, in standard deviations of the whole: equal
components would receive equal gradients and stay equal."""

LOG_SCALE_LIMIT = 7.0
"""Largest logarithm of a precision factor's diagonal element, either way: components between a
thousandth and a thousand of the linear regression's residuals wide."""


class MixtureDensityNetwork(nn.Module):
    """A conditional mixture of Gaussians in the whitened parameters u.

        q(u | f) = sum_k w_k N(u; U_k^-1 v_k, (U_k^T U_k)^-1),

    whose log weights w_k, upper triangular precision factors U_k and whitened means v_k are
    linear in a hidden layer h(f).

    Where a row's parameters came from a proposal, the network is evaluated as the proposal
    posterior q(u | f) t(u) / Z(f), see :mod:`npdr_ppl.inference.proposal_correction`.

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
        # Per component a weight and the rows of the matrix [U, v], of which U's are triangular.
        self.sizes = [components * (num_parameters - i + 1) for i in range(num_parameters)]
        self.head = nn.Linear(num_hidden, components + sum(self.sizes))
        means = torch.randn(components, num_parameters)
        means = means - means.mean(0)
        means = means * (INITIAL_SPREAD / means.square().mean(0).sqrt().clamp(min=1e-6))
        spread = INITIAL_SPREAD if components > 1 else 0.0
        scale = 1 / math.sqrt(1 - spread**2)
        with torch.no_grad():
            self.head.weight.mul_(INITIAL_SCALE)
            self.head.bias.zero_()
            rows = self.head.bias[components:].split(self.sizes)
            for i, row in enumerate(rows):
                by_component = row.view(-1, components)
                by_component[0] = _inverse_bound(math.log(scale))
                if components > 1:
                    by_component[-1] = scale * means[:, i]

    def parameters_at(self, f: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Returns the mixtures' parameters at standardised features ``(n, ...)``.

        The rows are numbered by the last dimension, so that the many small operations on
        matrices run along contiguous memory.

        Returns:
            Log weights ``(K, n)``, log diagonals of U ``(d, K, n)``, and the rows of [U, -v] from
            the diagonal on, each ``(d - i + 1, K, n)``.
        """
        h = self.hidden(f if self.embedding is None else self.embedding(f))
        raw = self.head.weight @ h.mT + self.head.bias[:, None]
        logits, rest = raw[: self.components], raw[self.components :]
        rows, log_scales = [], []
        for i, flat in enumerate(rest.split(self.sizes)):
            row = flat.view(self.num_parameters - i + 1, self.components, -1)
            log_scale = row[:1] / (1 + row[:1].abs() / LOG_SCALE_LIMIT)
            log_scales.append(log_scale)
            rows.append(torch.cat((log_scale.exp(), row[1:-1], -row[-1:])))
        return logits.log_softmax(0), torch.cat(log_scales), rows

    def forward(self, u: Tensor, f: Tensor) -> Tensor:
        """Returns log q(u | f), or that of the proposal posterior, ``(n,)``.

        Args:
            u: Whitened parameters, ``(n, d)``; those drawn from a proposal are followed by the
                quadratic forms of its tilt at the same row, ``(n, d + J (d + 1)^2)``.
            f: Standardised features, ``(n, ...)``.
        """
        d = self.num_parameters
        log_weights, log_scales, rows = self.parameters_at(f)
        log_volume = log_weights + log_scales.sum(0)
        point = torch.cat((u[:, :d].mT, torch.ones_like(u[:, :1]).mT))
        square: Tensor | float = 0.0
        for i, row in enumerate(rows):
            square = square + (row * point[i:, None]).sum(0) ** 2
        log_q = (log_volume - 0.5 * square).logsumexp(0) - 0.5 * d * math.log(2 * math.pi)
        if u.shape[1] == d:
            return log_q
        forms = u[:, d:].mT.reshape(-1, d + 1, d + 1, len(u)).permute(1, 2, 0, 3)
        exponent = ((forms * point[:, None, None]).sum(0) * point[:, None]).sum(0)
        log_tilt = (-0.5 * exponent).logsumexp(0)
        log_normaliser = log_volume[None] + _log_integral(forms[:, :, :, None], rows)
        return log_q + log_tilt - log_normaliser.flatten(0, 1).logsumexp(0)


def _log_integral(forms: Tensor, rows: list[Tensor]) -> Tensor:
    """Integrates Gaussians times exponentials of quadratic forms by Gaussian elimination.

    Eliminates one parameter after another from the sum of a form and [U, -v]^T [U, -v]; row i of
    the latter is added just before parameter i is eliminated, because it has no entries before.

    Args:
        forms: Quadratic forms, ``(d + 1, d + 1, J, 1, n)``.
        rows: Rows of [U, -v] from the diagonal on, each ``(d - i + 1, K, n)``.

    Returns:
        log int exp(-1/2 (u, 1)^T (form + [U, -v]^T [U, -v]) (u, 1)) du / (2 pi)^(d / 2),
        ``(J, K, n)``.
    """
    log_det: Tensor | float = 0.0
    left = forms
    for row in rows:
        left = left + (row[:, None] * row[None])[:, :, None]
        # Not smaller than the square of U's diagonal but for rounding: the form is nonnegative.
        pivot = torch.maximum(left[0, 0], (row[0] ** 2)[None])
        log_det = log_det + pivot.log()
        column = left[1:, 0]
        left = left[1:, 1:] - column[:, None] * (column / pivot)[None]
    return -0.5 * (log_det + left[0, 0])


def _inverse_bound(log_scale: float) -> float:
    """Returns what the bound on log scales maps to a value."""
    return log_scale / (1 - abs(log_scale) / LOG_SCALE_LIMIT)


def perceptron(num_features: int, widths: tuple[int, ...]) -> nn.Sequential:
    """Returns fully connected layers of given widths."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(num_features, width), nn.ReLU()]
        num_features = width
    return nn.Sequential(*layers)


def mixture_at(
    network: MixtureDensityNetwork, preconditioner: Preconditioner, observation: Tensor
) -> GaussianMixture:
    """Returns a trained network's posterior given an observation, in reference coordinates.

    Args:
        network: The network.
        preconditioner: What was fitted before training, on the same device.
        observation: Observation x_o, ``(F,)`` or a raw array, on the same device.
    """
    d = network.num_parameters
    features = preconditioner.features(observation[None])
    with torch.no_grad():
        log_weights, _, rows = network.parameters_at(features)
    joint = torch.zeros(network.components, d, d + 1, dtype=torch.float64)
    for i, row in enumerate(rows):
        joint[:, i, i:] = row[..., 0].mT.cpu().double()
    factors, whitened = joint[..., :-1], -joint[..., -1:]
    means = torch.linalg.solve_triangular(factors, whitened, upper=True)[..., 0]
    scale = preconditioner.factor.cpu().double()
    shift = preconditioner.shift(features)[0].cpu().double()
    roots = torch.linalg.solve_triangular(scale, factors, upper=False, left=False)
    return GaussianMixture(
        log_weights[:, 0].cpu(), means @ scale.T + shift, triangular_factors(roots)
    )
