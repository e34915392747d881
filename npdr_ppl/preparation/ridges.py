"""Coordinates along a curved ridge of a posterior.

If a motion determines fewer combinations than there are parameters, the posterior is a thin sheet.
Across it are stiff directions, in which it is a thousand times narrower than the prior; along it
are weak ones, in which it is hardly narrower. If the sheet is curved even slightly, a normal
approximation fails. Let a be the weak coordinates of the prior-whitened information along which
the posterior is curved, the six most curved ones if there are more, and b all others. The ridge b
= g(a) is traced by Newton steps with the Jacobian of the closest fit (the chord method), fitted by
a polynomial, and subtracted. The shear (a, b) → (a, b − g(a)) preserves volumes, so densities need
no correction for it.

The curvature at the closest fit makes a curved ridge look shorter than it is. Its length is
therefore found from the traced points. They are weighted by the ratio of their posterior density
to the density that they were drawn from. The next points are drawn with the mean and covariance of
the weighted ones (adaptive importance sampling along the ridge), until these no longer change.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step
from npdr_ppl.inference.parts.samplers.walkers import LogDensity
from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.polynomials import Polynomial, fit_polynomial, num_terms
from npdr_ppl.preparation.sampling_coordinates import SamplingCoordinates
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING, RIDGE
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.randomness import seeded

__all__ = ["RidgeCoordinates", "log_density_of"]


@dataclass(frozen=True)
class RidgeCoordinates:
    """Coordinates w of a posterior in which its ridges are straight and along axes.

    Attributes:
        space: The coordinates y from which w are computed.
        centre: The point near the closest fit with the greatest density over reference
            coordinates, mapped to y, ``(d,)``.
        basis: Columns map w − shear to y − centre, ``(d, d)``.
        information: Information of the recording in units of the prior's, ``(d,)``; ascending
            among the weak coordinates and among the others.
        num_weak: Number of weak coordinates, which come first in w.
        bend: Polynomial g in the weak ones; zero, of degree 0, if no ridge was traced.
        weak_mean: Mean of the posterior's weak coordinates, estimated from the traced
            points, ``(num_weak,)``.
        weak_covariance: Their covariance, ``(num_weak, num_weak)``.
    """

    space: SamplingCoordinates
    centre: Tensor
    basis: Tensor
    information: Tensor
    num_weak: int
    bend: Polynomial
    weak_mean: Tensor
    weak_covariance: Tensor

    @classmethod
    def of(
        cls, likelihood: SegmentLikelihood, *, seed: int, is_rough: bool = False
    ) -> "RidgeCoordinates":
        """Finds the coordinates of a recording's posterior.

        Args:
            likelihood: The recording's likelihood.
            seed: Seed of the points of a ridge.
            is_rough: Whether ridges are taken as straight, which needs few simulations.
        """
        z, known = likelihood.fit.z, likelihood.information()
        # Even with all others known, the recording says less about these than the prior.
        space = SamplingCoordinates.of(likelihood.segments.prior, known.diagonal() < 1.0)
        slope = space.slope(z).clamp_min(1e-12)
        spread = space.variance.sqrt()
        scaled = known * (spread / slope)[:, None] * (spread / slope)
        information, vectors = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
        information = information.clamp_min(0.0)
        can_be_weak = 0 if is_rough else _num_weak(information)
        basis = spread[:, None] * vectors
        centre = space.from_reference(_most_likely(likelihood, known)[None])[0]
        straight = cls._straight(space, centre, basis, information, 0)
        is_weak = torch.zeros(len(z), dtype=torch.bool)
        is_weak[:can_be_weak] = True
        if 0 < can_be_weak < len(z):
            density = log_density_of(likelihood, straight)
            is_weak[:can_be_weak] = straight._most_curved(density, can_be_weak)
        order = torch.cat((is_weak.nonzero()[:, 0], (~is_weak).nonzero()[:, 0]))
        num_weak = int(is_weak.sum())
        found = cls._straight(
            space, straight.centre, basis[:, order], information[order], num_weak
        )
        is_traced = 0 < num_weak < len(z)
        return found._traced(likelihood, slope, seed) if is_traced else found

    @classmethod
    def _straight(
        cls,
        space: SamplingCoordinates,
        centre: Tensor,
        basis: Tensor,
        information: Tensor,
        num_weak: int,
    ) -> "RidgeCoordinates":
        """Returns coordinates of which no ridge is known; see the attributes."""
        return cls(
            space,
            centre,
            basis,
            information,
            num_weak,
            Polynomial.zero(len(centre) - num_weak),
            torch.zeros(num_weak, dtype=torch.float64),
            torch.diag(1.0 / (1.0 + information[:num_weak])),
        )

    def _most_curved(self, log_density: LogDensity, num: int) -> Tensor:
        """Returns along which of the first coordinates the posterior is most curved, ``(num,)``.

        They are ``RIDGE.most_weak`` at most, because the number of points of a ridge grows with
        the square of theirs. Curvature is seen near the closest fit only.

        Args:
            log_density: The posterior's log density over w.
            num: Number of the coordinates.
        """
        axes = torch.eye(num, dtype=torch.float64)
        missed = self._missed(log_density, axes)
        straight = (missed <= RIDGE.straight_gain).nonzero()[:, 0]
        if num - len(straight) < RIDGE.most_weak and len(straight) > 1:
            # A ridge can be curved between two coordinates along each of which it is straight.
            first, second = straight[torch.triu_indices(len(straight), len(straight), 1)]
            between = self._missed(log_density, (axes[first] + axes[second]) / 2.0**0.5)
            for members in (first, second):
                missed = missed.scatter_reduce(0, members, between, "amax")
        is_curved = torch.zeros(num, dtype=torch.bool)
        is_curved[missed.argsort(descending=True)[: RIDGE.most_weak]] = True
        return is_curved & (missed > RIDGE.straight_gain)

    def _missed(self, log_density: LogDensity, directions: Tensor) -> Tensor:
        """Returns by how much a normal posterior is wrong at two standard deviations, ``(n,)``.

        It is the difference of log densities, the mean of both sides, because a slope is no
        curvature. It is infinite where both sides are outside the prior's support.

        Args:
            log_density: The posterior's log density over w.
            directions: Directions among the first k coordinates, in standard deviations,
                ``(n, k)``.
        """
        num = directions.shape[1]
        away = 2.0 * torch.cat((directions, -directions))
        w = torch.zeros(len(away) + 1, len(self.centre), dtype=torch.float64)
        w[1:, :num] = away / (1.0 + self.information[:num]).sqrt()
        density = torch.where(self.to_reference(w)[1], log_density(w), torch.nan)
        normal = -0.5 * away.square().sum(-1)
        missed = (density[1:] - density[0] - normal).unflatten(0, (2, -1)).nanmean(0)
        return missed.abs().nan_to_num(torch.inf, torch.inf, torch.inf)

    def tensors(self) -> dict[str, Tensor]:
        """Returns the tensors from which, with the prior, the coordinates can be rebuilt."""
        return {
            **self.space.tensors(),
            "centre": self.centre,
            "basis": self.basis,
            "information": self.information,
            "coefficients": self.bend.coefficients,
            "shape": torch.tensor([self.num_weak, self.bend.degree]),
            "weak_mean": self.weak_mean,
            "weak_covariance": self.weak_covariance,
        }

    @classmethod
    def of_tensors(cls, prior: Prior, tensors: Mapping[str, Tensor]) -> "RidgeCoordinates":
        """Rebuilds coordinates of a prior from :meth:`tensors`."""
        num_weak, degree = tensors["shape"].tolist()
        return cls(
            SamplingCoordinates.of_tensors(prior, tensors),
            tensors["centre"],
            tensors["basis"],
            tensors["information"],
            int(num_weak),
            Polynomial(tensors["coefficients"], int(degree)),
            tensors["weak_mean"],
            tensors["weak_covariance"],
        )

    def moments(self) -> tuple[Tensor, Tensor]:
        """Returns approximate mean ``(d,)`` and covariance ``(d, d)`` of the posterior in w."""
        k, d = self.num_weak, len(self.centre)
        mean = torch.zeros(d, dtype=torch.float64)
        covariance = torch.diag(1.0 / (1.0 + self.information))
        mean[:k], covariance[:k, :k] = self.weak_mean, self.weak_covariance
        return mean, covariance

    def heavy_tailed(self) -> GaussianMixture:
        """Returns a density over w with these moments at its centre and heavy tails."""
        mean, covariance = self.moments()
        weights, factors = (
            torch.tensor(column, dtype=torch.float64)
            for column in zip(*IMPORTANCE_SAMPLING.tails, strict=True)
        )
        return GaussianMixture.from_moments(
            weights, mean.expand(len(weights), -1), factors[:, None, None] * covariance
        )

    def from_reference(self, z: Tensor) -> Tensor:
        """Maps reference coordinates ``(n, d)`` to w."""
        away = self.space.from_reference(z) - self.centre
        w = torch.linalg.solve(self.basis, away.mT).mT
        weak = w[:, : self.num_weak]
        return torch.cat((weak, w[:, self.num_weak :] - self.bend(weak)), dim=-1)

    def to_reference(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Maps w ``(n, d)`` to reference coordinates; also returns which lie on the support."""
        weak = w[:, : self.num_weak]
        moved = torch.cat((weak, w[:, self.num_weak :] + self.bend(weak)), dim=-1)
        return self.space.to_reference(self.centre + moved @ self.basis.mT)

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Returns log |∂w/∂z|, ``(n,)``."""
        own = self.space.log_jacobian(z, self.space.from_reference(z))
        return own - torch.linalg.slogdet(self.basis).logabsdet

    def log_prior(self, z: Tensor) -> Tensor:
        """Returns the prior's log density over w, ``(n,)``, at reference coordinates."""
        return self.space.prior.log_prob(z).double() - self.log_jacobian(z)

    def _traced(
        self, likelihood: SegmentLikelihood, slope: Tensor, seed: int
    ) -> "RidgeCoordinates":
        """Returns the coordinates with a polynomial fitted to the ridge."""
        k, d, found = self.num_weak, len(self.centre), self
        number = max(RIDGE.fewest_points, RIDGE.points_per_term * num_terms(k, 2))
        points, values = torch.empty(0, d).double(), torch.empty(0).double()
        for round_ in range(RIDGE.most_rounds):
            factor = RIDGE.reach * torch.linalg.cholesky(found.weak_covariance)
            with seeded(seed, "ridge", round_):
                drawn = torch.randn(RIDGE.draw_factor * number, k, dtype=torch.float64)
            weak = found.weak_mean + drawn @ factor.mT
            _, inside = found.to_reference(torch.cat((weak, weak.new_zeros(len(weak), d - k)), -1))
            drawn, weak = drawn[inside][:number], weak[inside][:number]
            if not len(weak):
                break
            steps = RIDGE.first_chord_steps if round_ == 0 else RIDGE.chord_steps
            w, predicted, log_density = found._followed(likelihood, weak, slope, steps)
            is_found = log_density.isfinite()
            if float(is_found.double().mean()) < RIDGE.least_found_share:
                break
            missed = (log_density - predicted)[is_found].median()
            points, values = torch.cat((points, w)), torch.cat((values, log_density))
            found = found._bent_through(points, values)
            log_weights = log_density + 0.5 * drawn.square().sum(-1)
            exponent = longest_step(log_weights, 1.0, RIDGE.even_share)
            weights = (exponent * log_weights).nan_to_num(-torch.inf).softmax(0)
            mean = weights @ weak
            away = weak - mean
            # The small addition keeps the matrix regular if only few points have weight.
            covariance = (weights[:, None] * away).mT @ away + 1e-6 * found.weak_covariance
            grown = torch.linalg.eigvals(torch.linalg.solve(found.weak_covariance, covariance))
            found = replace(found, weak_mean=mean, weak_covariance=covariance)
            # The points lie where they were predicted, and their spread no longer grows.
            if (
                missed < RIDGE.close_gain
                and exponent == 1.0
                and float(grown.real.max()) < RIDGE.growth
            ):
                break
        return found

    def _followed(
        self, likelihood: SegmentLikelihood, weak: Tensor, slope: Tensor, steps: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the points of a ridge above weak coordinates ``(n, k)``.

        Returns:
            The points before the shear, ``(n, d)``; log densities, up to a constant, where the
            polynomial predicts the points, ``(n,)``; and log densities at the points, minus
            infinity for points that were not found.
        """
        k, d = self.num_weak, len(self.centre)
        straight = replace(self, bend=Polynomial.zero(d - k))
        by_w = self.basis / slope[:, None]  # ∂z/∂w at the closest fit
        stiff = self.information[k:] + 1.0
        w = torch.cat((weak, self.bend(weak)), dim=-1)
        best, value = w.clone(), torch.full((len(w),), -torch.inf, dtype=torch.float64)
        predicted, prior = value, likelihood.segments.prior
        is_moving = torch.ones(len(w), dtype=torch.bool)
        for step in range(steps + 1):
            z, inside = straight.to_reference(w)
            inside &= is_moving
            # Points outside the support cannot be simulated and have no score.
            score, density = torch.full_like(w, torch.nan), torch.full_like(value, -torch.inf)
            if bool(inside.any()):
                at = z[inside]
                score[inside], misfit = likelihood.scores(at)
                density[inside] = (
                    prior.log_prob(at).double() - 0.5 * misfit - straight.log_jacobian(at)
                ).nan_to_num(-torch.inf, -torch.inf, -torch.inf)
            if step == 0:
                predicted = density
            is_better = density > value
            best[is_better], value[is_better] = w[is_better], density[is_better]
            # The prior's gradient is approximated by that of a normal one of the same variance.
            change = ((score @ by_w)[:, k:] - w[:, k:]) / stiff
            change = change.nan_to_num(0.0).clamp(-RIDGE.longest_step, RIDGE.longest_step)
            is_moving = (change * stiff.sqrt()).norm(dim=-1) > RIDGE.shortest_step
            if not bool(is_moving.any()):
                break
            w = w.clone()
            w[is_moving, k:] += change[is_moving]
        return best, predicted, value

    def _bent_through(self, w: Tensor, log_density: Tensor) -> "RidgeCoordinates":
        """Returns the coordinates with a polynomial through points of the ridge, ``(n, d)``.

        The degree is the one with the smallest leave-one-out error, in standard deviations of the
        posterior.
        """
        k = self.num_weak
        near = log_density.argsort(descending=True)[: int(RIDGE.fitted_share * len(w))]
        near = near[log_density[near].isfinite()]
        # Points that are farther from the ridge than others have smaller weights.
        excess = log_density[near].max() - log_density[near]
        weight = (1.0 + excess / excess.median().clamp_min(0.5)).rsqrt()
        bend = fit_polynomial(
            w[near, :k],
            w[near, k:],
            weights=weight,
            importance=self.information[k:] + 1.0,
            most_degree=RIDGE.most_degree,
            points_per_coefficient=RIDGE.points_per_coefficient,
        )
        return self if bend is None else replace(self, bend=bend)


def log_density_of(likelihood: SegmentLikelihood, space: RidgeCoordinates) -> LogDensity:
    """Returns the posterior's log density over the coordinates w, up to a constant."""

    def log_density(w: Tensor) -> Tensor:
        z, inside = space.to_reference(w)
        result = torch.full((len(w),), -torch.inf, dtype=torch.float64)
        if bool(inside.any()):
            at = z[inside]
            result[inside] = likelihood.log_prob(at) + space.log_prior(at)
        return result.nan_to_num(-torch.inf, -torch.inf, -torch.inf)

    return log_density


def _num_weak(information: Tensor) -> int:
    """Returns along how many directions a ridge may be curved; the information is ascending.

    Along a direction of width δ the ridge departs from a line by about δ², in units of the prior.
    The direction can be weak if that exceeds the width of the stiffest one.
    """
    return int((information**2 < information[-1]).sum())


def _most_likely(likelihood: SegmentLikelihood, information: Tensor) -> Tensor:
    """Returns the most likely point near the closest fit, ``(d,)``.

    The fit counts all measurements, as if they were independent. With their effective number, the
    prior weighs more, and parameters about which the recording says little are nearer to its
    middle. Newton steps with the derivatives of the fit lead there.

    Args:
        likelihood: The recording's likelihood.
        information: Its information at the closest fit, ``(d, d)``.
    """
    z, prior = likelihood.fit.z, likelihood.segments.prior
    eye = torch.eye(len(z), dtype=torch.float64)
    factors = torch.tensor(RIDGE.centre_steps, dtype=torch.float64)[:, None]
    tried, best = z[None], -torch.inf
    for _ in range(RIDGE.most_centre_steps + 1):
        scores, misfits = likelihood.scores(tried)
        density = (prior.log_prob(tried).double() - 0.5 * misfits).nan_to_num(-torch.inf)
        chosen = int(density.argmax())
        gain = float(density[chosen]) - best
        if not gain > 0.0:
            break
        z, best = tried[chosen], float(density[chosen])
        if gain < RIDGE.centre_gain:
            break
        change = torch.linalg.solve(information + eye, scores[chosen] - z)
        tried = z + factors * change.nan_to_num(0.0)
    return z
