"""Coordinates along a ridge of a posterior that bends.

Where a motion determines fewer combinations than there are parameters, the posterior is a thin
sheet: stiff directions, a thousand times narrower than the prior, across weak ones that are hardly
narrower. Even a slight bend of the sheet defeats a normal approximation. With weak coordinates a
and stiff coordinates b of the prior-whitened information, b = g(a) is traced by Newton steps with
the Jacobian of the closest fit (the chord method), fitted by a polynomial, and subtracted. The
shear (a, b) → (a, b − g(a)) keeps volumes, so densities need no correction for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

from npdr_ppl.language.prior import Prior
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.sampling_coordinates import SamplingCoordinates
from npdr_ppl.workflows.segment_likelihood import SegmentLikelihood

__all__ = ["RidgeCoordinates"]

STIFF = 30.0
"""Information in units of the prior's from which a direction counts as stiff: its posterior is
then narrower than 0.18 prior standard deviations."""

POINTS = 256
"""Points at which a ridge is traced, each a simulation of the recording per chord step."""

CHORD_STEPS = 5
"""Chord steps to each of them."""

REACH = 1.3
"""How far weak coordinates of these points are spread, in posterior standard deviations."""

FARTHEST = 1.0
"""Greatest chord step along a stiff direction, in prior standard deviations."""

KEPT = 0.75
"""Share of the points, those nearest to the recording, that the polynomial is fitted to; chord
steps need not converge everywhere."""


@dataclass(frozen=True)
class RidgeCoordinates:
    """Coordinates w of a posterior in which its ridges are straight and along axes.

    Attributes:
        space: The coordinates y that w are made of.
        centre: The closest fit in them, ``(d,)``.
        basis: Columns map w − shear to y − centre, ``(d, d)``.
        information: Information of the recording in units of the prior's, ``(d,)`` ascending.
        num_weak: How many of w are weak; they come first.
        coefficients: Polynomial g in the weak ones, ``(terms, d − num_weak)``.
        degree: Its degree, 0 where there is no bend to trace.
    """

    space: SamplingCoordinates
    centre: Tensor
    basis: Tensor
    information: Tensor
    num_weak: int
    coefficients: Tensor
    degree: int

    @classmethod
    def of(cls, likelihood: SegmentLikelihood, *, seed: int) -> "RidgeCoordinates":
        """Finds the coordinates of a recording's posterior."""
        space = SamplingCoordinates.of(likelihood.segments.prior)
        z = likelihood.fit.z
        slope = space.slope(z).clamp_min(1e-12)
        spread = space.variance.sqrt()
        scaled = likelihood.information() * (spread / slope)[:, None] * (spread / slope)
        information, vectors = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
        information = information.clamp_min(0.0)
        num_weak = int((information < STIFF).sum())
        straight = cls(
            space,
            space.from_reference(z[None])[0],
            spread[:, None] * vectors,
            information,
            num_weak,
            torch.zeros(1, len(z) - num_weak, dtype=torch.float64),
            0,
        )
        if num_weak in (0, len(z)):
            return straight
        return straight._traced(likelihood, slope, seed)

    def tensors(self) -> dict[str, Tensor]:
        """Returns what the coordinates consist of beside the prior, to be written to disk."""
        return {
            "centre": self.centre,
            "basis": self.basis,
            "information": self.information,
            "coefficients": self.coefficients,
            "shape": torch.tensor([self.num_weak, self.degree]),
        }

    @classmethod
    def of_tensors(cls, prior: Prior, tensors: Mapping[str, Tensor]) -> "RidgeCoordinates":
        """Rebuilds coordinates of a prior from :meth:`tensors`."""
        num_weak, degree = tensors["shape"].tolist()
        return cls(
            SamplingCoordinates.of(prior),
            tensors["centre"],
            tensors["basis"],
            tensors["information"],
            int(num_weak),
            tensors["coefficients"],
            int(degree),
        )

    @property
    def deviation(self) -> Tensor:
        """Standard deviations of w in Laplace's approximation, ``(d,)``."""
        return (1.0 + self.information).rsqrt()

    def from_reference(self, z: Tensor) -> Tensor:
        """Maps reference coordinates ``(n, d)`` to w."""
        away = self.space.from_reference(z) - self.centre
        w = torch.linalg.solve(self.basis, away.mT).mT
        weak = w[:, : self.num_weak]
        return torch.cat((weak, w[:, self.num_weak :] - self._bend(weak)), dim=-1)

    def to_reference(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Maps w ``(n, d)`` to reference coordinates; also returns which lie on the support."""
        weak = w[:, : self.num_weak]
        moved = torch.cat((weak, w[:, self.num_weak :] + self._bend(weak)), dim=-1)
        return self.space.to_reference(self.centre + moved @ self.basis.mT)

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Returns log |∂w/∂z|, ``(n,)``."""
        own = self.space.log_jacobian(z, self.space.from_reference(z))
        return own - torch.linalg.slogdet(self.basis).logabsdet

    def _bend(self, weak: Tensor) -> Tensor:
        return _monomials(weak, self.degree) @ self.coefficients

    def _traced(
        self, likelihood: SegmentLikelihood, slope: Tensor, seed: int
    ) -> "RidgeCoordinates":
        """Returns the coordinates with the polynomial that the ridge follows."""
        k, d = self.num_weak, len(self.centre)
        with seeded(seed, "ridge"):
            weak = REACH * self.deviation[:k] * torch.randn(POINTS, k, dtype=torch.float64)
        w = torch.cat((weak, torch.zeros(POINTS, d - k, dtype=torch.float64)), dim=-1)
        z, inside = self.to_reference(w)
        w, z, inside = w[inside], z[inside], inside[inside]
        by_w = self.basis / slope[:, None]  # ∂z/∂w at the closest fit
        stiff = self.information[k:] + 1.0
        squares = torch.full((len(w),), torch.inf, dtype=torch.float64)
        best = w.clone()
        for _ in range(CHORD_STEPS):
            if not len(w):
                return self
            # Beyond the support nothing can be simulated: there the point has no score.
            score = torch.full_like(w, torch.nan)
            value = torch.full((len(w),), torch.inf, dtype=torch.float64)
            if bool(inside.any()):
                score[inside], value[inside] = likelihood.scores(z[inside])
            is_better = value < squares
            best[is_better], squares[is_better] = w[is_better], value[is_better]
            # The prior's own pull is that of a normal one of the same variance.
            step = ((score @ by_w)[:, k:] - w[:, k:]) / stiff
            w = w.clone()
            w[:, k:] += step.nan_to_num(0.0).clamp(-FARTHEST, FARTHEST)
            z, inside = self.to_reference(w)
        near = squares.argsort()[: int(KEPT * len(squares))]
        near = near[squares[near].isfinite()]
        degree = next((p for p in (3, 2, 1) if 4 * _num_terms(k, p) <= len(near)), 0)
        if degree == 0:
            return self
        # Points off the ridge by more than others say less of where it is.
        excess = squares[near] - squares[near].min()
        weight = (1.0 + excess / excess.median().clamp_min(1.0)).rsqrt()
        terms = _monomials(best[near, :k], degree)
        found = torch.linalg.lstsq(weight[:, None] * terms, weight[:, None] * best[near, k:])
        return RidgeCoordinates(
            self.space, self.centre, self.basis, self.information, k, found.solution, degree
        )


def _num_terms(number: int, degree: int) -> int:
    return sum(1 for _ in _exponents(number, degree))


def _exponents(number: int, degree: int) -> list[tuple[int, ...]]:
    """Returns which variables each monomial multiplies, the constant first."""
    return [
        chosen
        for power in range(degree + 1)
        for chosen in combinations_with_replacement(range(number), power)
    ]


def _monomials(values: Tensor, degree: int) -> Tensor:
    """Returns all monomials of ``(n, k)`` variables up to a degree, ``(n, terms)``."""
    columns = []
    for chosen in _exponents(values.shape[1], degree):
        column = torch.ones(len(values), dtype=torch.float64)
        for index in chosen:
            column = column * values[:, index]
        columns.append(column)
    return torch.stack(columns, dim=-1)
