"""The effect of a Gaussian proposal on a posterior, and its correction, in closed form.

Parameters drawn from a proposal p~(z) instead of the prior p(z) = N(0, I) change the posterior to
the *proposal posterior*

    q~(z | x) = q(z | x) t(z) / Z(x),      t(z) = p~(z) / p(z),      Z(x) = int q(z | x) t(z) dz

(Papamakarios & Murray 2016, Proposition 1). For a mixture p~ = sum_j b_j N(m_j, S_j) the
tilt t is a sum of exponentials of quadratic forms,

    t(z) = sum_j exp(-1/2 (z, 1)^T T_j (z, 1)),
    T_j = [[S_j^-1 - I, -S_j^-1 m_j], [., m_j^T S_j^-1 m_j + log det S_j - 2 log b_j]],

so that the product of t and a mixture of Gaussians is a mixture of Gaussians, and Z is known. With
proposals no wider than the prior in any direction, S_j <= I, the upper left block is positive
semidefinite. The product of t and a Gaussian is then integrable for any covariance.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture, triangular_factors
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = [
    "PROPOSALS",
    "correct_regression",
    "proposal_of",
    "tilt_forms",
    "whiten_forms",
]

PROPOSALS = ("gaussian", "mixture")


def proposal_of(
    posteriors: Sequence[GaussianMixture], kind: Literal["gaussian", "mixture"]
) -> GaussianMixture:
    """Returns the next round's proposal: the posterior, made no wider than the prior.

    Eigenvalues of a covariance are limited to one, the variance of the prior.

    Args:
        posteriors: The posteriors of an ensemble's members.
        kind: ``"mixture"``, their equal mixture, or ``"gaussian"``, the Gaussian with its moments.
    """
    proposal = GaussianMixture(
        torch.cat([q.log_weights for q in posteriors]),
        torch.cat([q.means for q in posteriors]),
        torch.cat([q.precision_factors for q in posteriors]),
    )
    if kind == "gaussian":
        mean, covariance = proposal.moments()
        proposal = GaussianMixture.from_moments(mean.new_ones(1), mean[None], covariance[None])
    left, singular, right = torch.linalg.svd(proposal.precision_factors)
    del left  # T^T T depends on the singular values and the right vectors only
    roots = singular.clamp(min=1.0)[..., None] * right
    return GaussianMixture(proposal.log_weights, proposal.means, triangular_factors(roots))


def tilt_forms(proposal: GaussianMixture) -> Tensor:
    """Returns the quadratic forms T_j of a proposal's tilt, ``(J, d + 1, d + 1)``."""
    factors, means = proposal.precision_factors, proposal.means
    white = (factors @ means[..., None])[..., 0]
    linear = (factors.mT @ white[..., None])[..., 0]
    log_det = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    forms = means.new_empty(len(means), means.shape[1] + 1, means.shape[1] + 1)
    eye = torch.eye(means.shape[1], dtype=means.dtype, device=means.device)
    forms[:, :-1, :-1] = factors.mT @ factors - eye
    forms[:, :-1, -1] = forms[:, -1, :-1] = -linear
    forms[:, -1, -1] = (white**2).sum(-1) - 2 * log_det - 2 * proposal.log_weights
    return forms


def whiten_forms(forms: Tensor, factor: Tensor, shift: Tensor) -> Tensor:
    """Rewrites quadratic forms of z as quadratic forms of u, where z = L u + s.

    Args:
        forms: Quadratic forms, ``(n, J, d + 1, d + 1)`` in float64.
        factor: Matrix L, ``(d, d)``.
        shift: Shift s of each row, ``(n, d)``.

    Returns:
        Quadratic forms, ``(n, J, d + 1, d + 1)`` in float64.
    """
    n, d = shift.shape
    change = forms.new_zeros(n, 1, d + 1, d + 1)
    change[..., :-1, :-1] = factor
    change[:, 0, :-1, -1] = shift.double()
    change[..., -1, -1] = 1.0
    return change.mT @ forms @ change


def correct_regression(
    preconditioner: Preconditioner, proposal: GaussianMixture
) -> Preconditioner:
    """Divides a regression's Gaussian, N(z; A f + b, L L^T), by a proposal's tilt.

    The regression was made on draws from the proposal. Its precision minus that of the proposal is
    the likelihood's. This difference can be negative only by chance; in such directions the
    simulations are assumed to have no information.

    Args:
        preconditioner: A regression of z on f.
        proposal: The proposal; a mixture is replaced by the Gaussian with its moments.

    Returns:
        The preconditioner of the posterior; for linear-Gaussian models it is exact up to
        sampling error.
    """
    (proposal,) = (proposal_of([proposal], "gaussian"),)
    root = proposal.precision_factors[0]
    scale, gain = preconditioner.factor.double(), preconditioner.gain.double()
    narrowed = root @ scale
    eye = torch.eye(len(scale), dtype=torch.float64, device=scale.device)
    surplus, directions = torch.linalg.eigh(eye - narrowed.mT @ narrowed)
    informed = directions * (surplus > 0)
    likelihood = (informed * surplus.clamp(min=0)) @ informed.mT
    # All in u, where z = L u + A f + b: the prior's precision is L^T L.
    precision = scale.mT @ scale + likelihood
    lower = torch.linalg.cholesky(precision)
    to_mean = scale @ torch.cholesky_solve(informed @ informed.mT, lower)
    white_gain = torch.linalg.solve_triangular(scale, gain, upper=False)
    white_offset = torch.linalg.solve_triangular(
        scale, preconditioner.offset.double()[:, None], upper=False
    )[:, 0]
    white_offset = white_offset - narrowed.mT @ (root @ proposal.means[0])
    half = torch.linalg.solve_triangular(lower, scale.mT, upper=False)
    like = preconditioner.factor
    return replace(
        preconditioner,
        gain=(to_mean @ white_gain).to(like).contiguous(),
        offset=(to_mean @ white_offset).to(like).contiguous(),
        factor=triangular_factors(half).mT.to(like).contiguous(),
    )
