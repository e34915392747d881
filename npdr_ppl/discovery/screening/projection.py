"""Removes from a change the part that initial states and parameters can imitate.

The initial state of each segment is known only within the smoother's error, and the parameters are
refitted together with any effect that is added. Both can therefore imitate an effect. Let r be the
residuals, G the derivatives by initial states and J the derivatives by parameters, all whitened.
Initial states are integrated out, segment by segment, with

    C = 1 + G Gᵀ,     C⁻¹ = 1 − G (1 + Gᵀ G)⁻¹ Gᵀ

Parameters are projected out, which leaves the part that J cannot explain. A column x has the score

    g = xᵀ C⁻¹ r − B Jᵀ C⁻¹ r,     B = xᵀ C⁻¹ J (Jᵀ C⁻¹ J + 1)⁻¹

and, with a second column y, the information xᵀ C⁻¹ y − B Jᵀ C⁻¹ y. Terms are independent between
segments but not within one. So the variance of a score is estimated from the scatter of the
segments' sums (Liang & Zeger 1986), never from the number of terms.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.language.effects import Effect

__all__ = ["Projection", "Scores", "loss_without"]


@dataclass(frozen=True)
class Scores:
    """Scores and information of P columns.

    Attributes:
        by_segment: Projected scores, ``(S, P)``.
        information: Projected information, ``(P, P)``.
        total: Information before the parameters were refitted, ``(P,)``.
    """

    by_segment: Tensor
    information: Tensor
    total: Tensor

    @property
    def score(self) -> Tensor:
        """Scores of all segments, ``(P,)``."""
        return self.by_segment.sum(0)

    @property
    def absorbed(self) -> Tensor:
        """Share of each column that refitted parameters explain, ``(P,)``."""
        return 1.0 - self.information.diagonal() / self.total.clamp_min(1e-30)

    def gain(self, own: slice) -> float:
        """Returns by how much some of the columns together reduce the misfit."""
        score = self.score[own]
        inverse = torch.linalg.pinv(self.information[own, own], hermitian=True)
        return float(score @ inverse @ score)


class Projection:
    """A fitted hypothesis, prepared to compute the scores of columns.

    Args:
        hypothesis: The hypothesis.
        keep: Mask of the coordinates of refitted parameters, ``(d,)``; all by default.
    """

    def __init__(self, hypothesis: Hypothesis, keep: Tensor | None = None) -> None:
        now = hypothesis.linearisation
        by_z = now.by_parameters if keep is None else now.by_parameters[..., keep]
        self.hypothesis = hypothesis
        self._starts = now.by_starts
        eye = torch.eye(now.by_starts.shape[-1], dtype=torch.float64)
        self._inner = eye + now.by_starts.mT @ now.by_starts
        #: Residuals with the initial states at the smoother's estimate, (S, N).
        self.residual = now.residual + (now.by_starts @ hypothesis.fit.offsets[..., None])[..., 0]
        self._by_z = by_z
        self._weights = self.solve(by_z)
        self._weighted = self.solve(self.residual[..., None])[..., 0]
        prior = torch.eye(by_z.shape[-1], dtype=torch.float64)
        self._information = (by_z.mT @ self._weights).sum(0) + prior
        self._score = (by_z.mT @ self._weighted[..., None])[..., 0]  # (S, d)

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out cached results, which the other process computes again if it needs them."""
        cached = {n for n, v in vars(type(self)).items() if isinstance(v, cached_property)}
        state = {name: value for name, value in vars(self).items() if name not in cached}
        return state | {"hypothesis": replace(self.hypothesis)}

    @cached_property
    def num_measured(self) -> Tensor:
        """Number of rows of each segment that were measured, ``(S,)``; the others are zero."""
        segments = self.hypothesis.segments
        ones = torch.ones_like(segments.observed)
        return (segments.whitened(ones, torch.ones_like(ones[0, 0])) > 0.0).sum(-1)

    def projected(self, columns: Tensor) -> Tensor:
        """Returns C^-½ x minus the part that refitted parameters explain.

        Its products with the whitened residuals are scores; those with itself are information.

        Args:
            columns: The columns x, ``(S, N, P)``.
        """
        return self.whitened(columns - self._by_z @ self.refit(self._explained(columns)))

    def whitened(self, columns: Tensor) -> Tensor:
        """Returns C^-½ x. If x is a residual, its components are independent, of unit variance.

        Args:
            columns: The columns x, ``(S, N, P)``.
        """
        directions, sizes, _ = self._starts_by_size
        shrunk = 1.0 - (1.0 + sizes.square()).rsqrt()
        return columns - directions @ (shrunk[..., None] * (directions.mT @ columns))

    @cached_property
    def _starts_by_size(self) -> tuple[Tensor, Tensor, Tensor]:
        """Singular value decomposition of the derivatives by initial states."""
        return torch.linalg.svd(self._starts, full_matrices=False)

    def _explained(self, columns: Tensor) -> Tensor:
        """Returns the parameters' scores with columns in place of residuals, ``(d, P)``."""
        return self.explained_by_segment(columns).sum(0)

    def explained_by_segment(self, columns: Tensor) -> Tensor:
        """Returns Jᵀ C⁻¹ x, ``(S, d, P)``, for columns x, ``(S, N, P)``."""
        return self._weights.mT @ columns

    def refit(self, explained: Tensor) -> Tensor:
        """Returns (Jᵀ C⁻¹ J + 1)⁻¹ y, the refitted parameters for the sum y of Jᵀ C⁻¹ x.

        Args:
            explained: The sums y, ``(d, P)``.
        """
        return torch.linalg.solve(self._information, explained)

    @cached_property
    def whitened_parameters(self) -> Tensor:
        """C^-½ J, ``(S, N, d)``."""
        return self.whitened(self._by_z)

    @property
    def parameter_scores(self) -> Tensor:
        """Scores of the parameters by segment, ``(S, d)``."""
        return self._score

    @property
    def parameter_information_by_segment(self) -> Tensor:
        """Information of the parameters in each segment, ``(S, d, d)``."""
        return self._by_z.mT @ self._weights

    def offsets_after(self, step: Tensor) -> Tensor:
        """Returns the closest offsets of the initial states after a step, ``(S, m)``.

        Args:
            step: Change of the parameters, ``(d,)``.
        """
        left = self.residual[..., None] - (self._by_z @ step)[..., None]
        return torch.linalg.solve(self._inner, self._starts.mT @ left)[..., 0]

    def solve(self, columns: Tensor) -> Tensor:
        """Returns C⁻¹ x, ``(S, N, P)``."""
        inner = torch.linalg.solve(self._inner, self._starts.mT @ columns)
        return columns - self._starts @ inner

    @cached_property
    def misfit(self) -> float:
        """rᵀ C⁻¹ r."""
        return float(self.misfit_by_segment.sum())

    @property
    def misfit_by_segment(self) -> Tensor:
        """The part of each segment in :attr:`misfit`, ``(S,)``."""
        return (self.residual * self._weighted).sum(-1)

    def scores(self, columns: Tensor) -> Scores:
        """Returns the scores of columns, ``(S, N, P)``."""
        weighted = self.solve(columns)
        cross = self._explained(columns)
        refit = self.refit(cross)
        own = (columns.mT @ weighted).sum(0)
        by_segment = (columns.mT @ self._weighted[..., None])[..., 0] - self._score @ refit
        return Scores(by_segment, own - cross.mT @ refit, own.diagonal())


def loss_without(hypothesis: Hypothesis, effect: Effect) -> float:
    """Returns the loss of evidence if one of a hypothesis's effects is removed.

    The compensation by other parameters and initial states is computed to first order.

    Args:
        hypothesis: The hypothesis.
        effect: One of its effects.
    """
    segments, fit = hypothesis.segments, hypothesis.fit
    resting = {
        f"{effect.name}.{p.name}": torch.tensor([p.nominal], dtype=torch.float64)
        for p in effect.strengths
    }
    box = segments.black_box(fit.z[None])
    starts = fit.offsets[None]
    present = segments.run(box.simulator, box.parameters, starts)[0]
    absent = segments.run(box.simulator, {**box.parameters, **resting}, starts)[0]
    change = segments.whitened(present - absent, fit.scale)
    if not bool(change.isfinite().all()):
        return math.nan
    keep = torch.ones(len(fit.z), dtype=torch.bool)
    for site in segments.prior.sites:
        if site.name in effect.parameter_names:
            keep[site.coordinates] = False
    information = Projection(hypothesis, keep).scores(change[..., None]).information
    return 0.5 * hypothesis.share * float(information)
