"""The likelihood of a recording, with the segments' initial states integrated out.

With whitened residuals r_s(z) of segment s, simulated from its estimated initial state, and their
derivatives G_s by the initial state in standard deviations of its error, r_s is normal with
covariance C_s = 1 + G_s G_sᵀ, and

    log p(x | z) = −½ w Σ_s [ r_s(z)ᵀ C_s⁻¹ r_s(z) / v + log |C_s| + N_s log v + constants ]

G is computed at the closest fit. The variance v is its squared residual per degree of freedom, or
one if the model declares its noise. The weight w is the effective number of
measurements as a share of all, because correlated residuals carry less information than
independent ones (composite likelihood; Ribatet, Cooley & Davison 2012).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from npdr_ppl.preparation.data_options import MAX_READINGS_PER_CHUNK
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import LINEARISATION

__all__ = ["SegmentLikelihood"]


@dataclass(frozen=True)
class SegmentLikelihood:
    """The likelihood of a recording under a model with one simulator; S segments.

    Attributes:
        segments: The model along the recording.
        fit: The closest fit, whose scale whitens the residuals.
        linearisation: Residuals and derivatives there.
        share: Effective number of measurements as a share of all, in (0, 1].
        is_noise_declared: Whether the fit's scale is noise that the model declares.
    """

    segments: SegmentModel
    fit: SegmentFit
    linearisation: Linearisation
    share: float
    is_noise_declared: bool

    @property
    def is_differentiable(self) -> bool:
        """Whether :meth:`log_prob` has gradients."""
        return self.segments.simulator.is_differentiable

    @cached_property
    def num_measurements(self) -> Tensor:
        """Number of measurements of each segment, ``(S,)``."""
        return self.segments.num_measured.sum(-1).double()

    @cached_property
    def _inner(self) -> Tensor:
        """1 + Gᵀ G, ``(S, m, m)``."""
        by_start = self.linearisation.by_starts
        return torch.eye(by_start.shape[-1], dtype=torch.float64) + by_start.mT @ by_start

    @cached_property
    def _corrected(self) -> SegmentModel:
        """The model in coarser steps, if the likelihood is the same with them around the fit.

        It is compared at two standard deviations along the direction that the recording determines
        least, and along the one that it determines best. Along a curved ridge, these points can be
        far from it: the less likely they are, the more it may err there.
        """
        model = self.segments.in_coarser_steps(self.fit.z, self.fit.offsets)
        if model is self.segments:
            return model
        eye = torch.eye(len(self.fit.z), dtype=torch.float64)
        values, vectors = torch.linalg.eigh(self.information() + eye)
        ends = 2.0 * (vectors / values.sqrt()).mT[[0, -1]]
        z = torch.cat((self.fit.z[None], self.fit.z + ends, self.fit.z - ends))
        coarser, own = (
            0.5
            * self.share
            / self.variance
            * torch.cat([self._squares(part).sum(-1) for part in self._residuals_of(each, z)])
            for each in (model, self.segments)
        )
        allowed = LINEARISATION.largest_step_error * (0.5 * (own - own[0])).clamp_min(1.0)
        is_alike = (coarser - own).abs() < allowed
        return model if bool(is_alike.all()) else self.segments

    @cached_property
    def misfit(self) -> float:
        """Misfit per degree of freedom at the closest fit: one if the residuals are only noise."""
        now = self.linearisation
        residual = now.residual + (now.by_starts @ self.fit.offsets[..., None])[..., 0]
        freedom = float(self.num_measurements.sum()) - len(self.fit.z)
        return float(self._squares(residual[None]).sum()) / max(1.0, freedom)

    @property
    def variance(self) -> float:
        """Variance v of the whitened residuals."""
        return 1.0 if self.is_noise_declared else max(self.misfit, 1e-12)

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns log p(recording | z), ``(n,)`` float64, at points ``(n, d)``.

        Minus infinity where a simulation fails.
        """
        together = max(1, MAX_READINGS_PER_CHUNK // max(1, len(self.fit.offsets)))
        return torch.cat([self.by_segment(part).sum(-1) for part in z.split(together)])

    def by_segment(self, z: Tensor) -> Tensor:
        """Returns log p(segment | z), ``(n, S)`` float64, at points ``(n, d)``."""
        squares = torch.cat([self._squares(residual) for residual in self._residuals(z)])
        log_scale = self.segments.num_measured.double() @ self.fit.scale.log()
        constant = (
            torch.linalg.slogdet(self._inner).logabsdet
            + self.num_measurements * math.log(2.0 * math.pi * self.variance)
            + 2.0 * log_scale
        )
        result = -0.5 * self.share * (squares / self.variance + constant)
        return torch.where(result.isfinite(), result, -torch.inf)

    def whitened(self, z: Tensor) -> Tensor:
        """Returns residuals q whose log density is −½ |q|² up to a constant, ``(n, S N)``.

        q = (w/v)^½ C^−½ r in float64 at points ``(n, d)``; not finite where a simulation fails.
        """
        left, shrunk = self._shrinkage
        found = []
        for residual in self._residuals(z):
            towards = shrunk * torch.einsum("snm,bsn->bsm", left, residual)
            found.append((residual + torch.einsum("snm,bsm->bsn", left, towards)).flatten(1))
        return math.sqrt(self.share / self.variance) * torch.cat(found)

    @cached_property
    def _shrinkage(self) -> tuple[Tensor, Tensor]:
        """Directions U of C^−½, ``(S, N, m)``, and what is added along them, ``(S, m)``."""
        left, sizes, _ = torch.linalg.svd(self.linearisation.by_starts, full_matrices=False)
        return left, (1.0 + sizes.square()).rsqrt() - 1.0

    def information(self) -> Tensor:
        """Returns the Fisher information of the parameters at the closest fit, ``(d, d)``."""
        return self.share * self.linearisation.information() / self.variance

    def scores(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Returns scores and misfits at points ``(n, d)``, with the closest fit's derivatives.

        The score is Jᵀ C⁻¹ r of the residuals r there, ``(n, d)``, and the misfit rᵀ C⁻¹ r,
        ``(n,)``, both in units of the variance and weighted by the share.
        """
        weights = self.linearisation.weights()
        scores, misfits = [], []
        for residual in self._residuals(z):
            scores.append(torch.einsum("snd,bsn->bd", weights, residual))
            misfits.append(self._squares(residual).sum(-1))
        factor = self.share / self.variance
        return factor * torch.cat(scores), factor * torch.cat(misfits)

    def _residuals(self, z: Tensor) -> Iterator[Tensor]:
        """Yields whitened residuals ``(n, S, N)`` at zero offsets, in chunks."""
        for points in z.double().split(self.segments.draws_per_chunk):
            (residual,) = self._residuals_of(self._corrected, points)
            failed = ~residual.flatten(1).isfinite().all(-1)
            if self._corrected is not self.segments and bool(failed.any()):
                # Coarser steps can be unstable where the model's own are not.
                (residual[failed],) = self._residuals_of(self.segments, points[failed])
            yield residual

    def _residuals_of(self, model: SegmentModel, z: Tensor) -> Iterator[Tensor]:
        """Yields whitened residuals of a model; see :meth:`_residuals`."""
        offsets = self.fit.offsets[None]
        moved = (self.linearisation.by_starts @ self.fit.offsets[..., None])[..., 0]
        for points in z.double().split(self.segments.draws_per_chunk):
            starts = offsets.expand(len(points), -1, -1)
            yield model.residuals(points, starts, self.fit.scale) + moved

    def _squares(self, residual: Tensor) -> Tensor:
        """Returns rᵀ C⁻¹ r by segment, ``(n, S)``, for residuals ``(n, S, N)``."""
        by_start = self.linearisation.by_starts
        towards = torch.einsum("snm,bsn->bsm", by_start, residual)
        taken = torch.linalg.solve(self._inner, towards[..., None])[..., 0]
        return residual.square().sum(-1) - (towards * taken).sum(-1)
