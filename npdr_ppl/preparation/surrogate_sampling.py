"""Draws of a posterior with polynomials in place of the simulator.

Simulations around the closest fit give polynomials for a recording's whitened residuals; see
:mod:`~npdr_ppl.preparation.residual_surrogate`. Markov chains draw from the posterior that
follows, without further simulations. Some of these draws are simulated, and weighted by the ratio
of the densities. While the weights are too unequal, these simulations join the others, and the
polynomials are fitted again: they become right where the posterior is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step, systematic
from npdr_ppl.inference.parts.samplers.walkers import LogDensity, ensemble_draws
from npdr_ppl.preparation.polynomials import num_terms
from npdr_ppl.preparation.residual_surrogate import ResidualSurrogate
from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING, RESIDUAL_SURROGATE
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.weighted_draws import WeightedDraws, effective_size, smoothed_weights
from npdr_ppl.randomness import derived_seed, seeded

__all__ = ["surrogate_draws"]


def surrogate_draws(
    likelihood: SegmentLikelihood,
    space: RidgeCoordinates,
    given: Sequence[Density] = (),
    *,
    seed: int,
    report: Callable[[str], None] = lambda _: None,
) -> WeightedDraws | None:
    """Draws from the posterior of a recording with polynomials in place of its residuals.

    Args:
        likelihood: The recording's likelihood.
        space: Coordinates in which the posterior's ridges are straight.
        given: Densities over reference coordinates that may be posteriors; some of their draws
            are simulated, to see whether the polynomials leave out a mode.
        seed: Seed of the draws.
        report: Called with a short status after each test of polynomials.

    Returns:
        ``None`` if polynomials do not represent the residuals, or leave out a mode, if chains do
        not mix, or if there are too many parameters or measurements.
    """
    settings, d = RESIDUAL_SURROGATE, len(likelihood.fit.z)
    num_first = max(settings.fewest_first, math.ceil(1.25 * num_terms(d, 2)))
    num_most = settings.most_bytes // (4 * likelihood.linearisation.residual.numel())
    if num_first > settings.most_first or num_first + settings.tested > num_most:
        return None
    mean, covariance = space.moments()
    scale = covariance.diagonal().sqrt()
    simulated = _Simulated(likelihood, space)
    with seeded(seed, "surrogate"):
        w = space.heavy_tailed().sample(settings.draw_factor * num_first).double()
        drawn = [density.sample(settings.tested).double().cpu() for density in given]
    simulated.add(w[space.to_reference(w)[1]][:num_first])
    if not len(simulated.w):
        return None
    others = torch.cat([torch.empty(0, d).double(), *map(space.from_reference, drawn)])
    values_of_others = simulated.values(others)
    reach = settings.first_reach
    for attempt in range(settings.most_fits):
        fitted = ResidualSurrogate.of(simulated.w, simulated.gram, mean, scale)
        if fitted is None or len(simulated.w) + settings.tested > num_most:
            return None
        is_last = attempt + 1 == settings.most_fits
        least_share = settings.least_share if is_last else settings.enough_share
        own_seed = derived_seed(seed, "surrogate", attempt)
        tested = _tested(simulated, fitted, reach, least_share, own_seed)
        report(f"{len(simulated.w)} draws, polynomials {tested.share:.0%} effective")
        if tested.is_right:
            found = tested.enough(simulated, attempt + 1)
            # Other draws that are as likely, but do not occur under the polynomials.
            least = tested.values[tested.values.isfinite()].quantile(settings.unlikely_share)
            is_missed = tested.density(others) < tested.density(tested.w).min()
            if bool(((values_of_others > least) & is_missed).any()):
                return None
            if found.is_reliable:
                return found
        elif tested.share < settings.least_share:
            reach = max(1.0, reach / settings.more_reach)
        elif tested.is_cut:
            reach = reach * settings.more_reach
    return None


class _Simulated:
    """Points of a posterior that were simulated.

    Args:
        likelihood: The recording's likelihood.
        space: Coordinates of the points.

    Attributes:
        space: The same.
        w: The points, ``(n, d)``.
        log_density: Their log density over w up to a constant, ``(n,)``.
        gram: Products of their residuals, ``(n, n)``.
    """

    def __init__(self, likelihood: SegmentLikelihood, space: RidgeCoordinates) -> None:
        self._likelihood = likelihood
        self.space = space
        self._residuals: list[Tensor] = []
        self.w = torch.empty(0, len(space.centre), dtype=torch.float64)
        self.log_density = torch.empty(0, dtype=torch.float64)
        self.gram = torch.empty(0, 0, dtype=torch.float64)

    def values(self, w: Tensor) -> Tensor:
        """Returns the log density of points ``(m, d)`` without keeping them.

        It is minus infinity outside the prior's support and where a simulation fails.
        """
        parts = w.split(RESIDUAL_SURROGATE.tested)
        return torch.cat([self._simulated(part)[0] for part in parts])

    def add(self, w: Tensor) -> Tensor:
        """Simulates points ``(m, d)`` and keeps them; see :meth:`values`.

        Points where the log density is not finite are not kept.
        """
        found = []
        for part in w.split(RESIDUAL_SURROGATE.tested):
            values, residuals = self._simulated(part)
            found.append(values)
            is_known = values.isfinite()
            if bool(is_known.any()):
                # Single precision suffices for polynomials, and halves the memory.
                self._residuals.append(residuals.float())
                self.gram = self._extended_gram(residuals)
                self.w = torch.cat((self.w, part[is_known]))
                self.log_density = torch.cat((self.log_density, values[is_known]))
        return torch.cat(found)

    def _simulated(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the log density of points, and residuals where it is finite."""
        values = torch.full((len(w),), -torch.inf, dtype=torch.float64)
        inside = torch.zeros(len(w), dtype=torch.bool)
        if len(w):
            z, inside = self.space.to_reference(w)
        if not bool(inside.any()):
            return values, torch.empty(0, dtype=torch.float64)
        residuals = self._likelihood.whitened(z[inside])
        found = self.space.log_prior(z[inside]) - 0.5 * residuals.square().sum(-1)
        # Residuals must not be too large for single precision.
        found = torch.where(found > torch.finfo(torch.float32).min, found, -torch.inf)
        values[inside] = found
        return values, residuals[found.isfinite()]

    def _extended_gram(self, new: Tensor) -> Tensor:
        """Returns the products with new residuals, the last ones, among them."""
        across = torch.cat([part.double() @ new.mT for part in self._residuals])
        before = len(self.gram)
        result = torch.zeros(len(across), len(across), dtype=torch.float64)
        result[:before, :before] = self.gram
        result[:, before:] = across
        result[before:] = across.mT
        return result


def _posterior(space: RidgeCoordinates, fitted: ResidualSurrogate, reach: float) -> LogDensity:
    """Returns the log density over w that follows from polynomials and the prior.

    Args:
        space: The coordinates w.
        fitted: The polynomials.
        reach: How far from the points of their fit they are trusted.
    """

    def log_density(w: Tensor) -> Tensor:
        result = torch.full((len(w),), -torch.inf, dtype=torch.float64)
        z, inside = space.to_reference(w) if len(w) else (w, torch.empty(0).bool())
        if bool(inside.any()):
            result[inside] = fitted(w[inside], reach) + space.log_prior(z[inside])
        return result.nan_to_num(-torch.inf, -torch.inf, -torch.inf)

    return log_density


@dataclass(frozen=True)
class _Tested:
    """Draws under polynomials, some of which were simulated.

    Attributes:
        made: The draws, ``(n, d)``.
        density: The log density under which they were made.
        values: The log density of the first ones by simulations, ``(m,)``.
        is_mixed: Whether the chains have forgotten where they began.
        is_cut: Whether the reach of the polynomials may have kept draws from going farther.
        least_share: Least effective share.
    """

    made: Tensor
    density: LogDensity
    values: Tensor
    is_mixed: bool
    is_cut: bool
    least_share: float

    @property
    def w(self) -> Tensor:
        """The draws that were simulated, ``(m, d)``."""
        return self.made[: len(self.values)]

    @cached_property
    def weights(self) -> tuple[Tensor, float]:
        """Smoothed log weights of the simulated draws, and the shape of their tail."""
        return smoothed_weights(self.values - self.density(self.w))

    @property
    def share(self) -> float:
        """Effective share of the simulated draws."""
        smoothed, k_hat = self.weights
        return effective_size(smoothed) / len(self.w) if math.isfinite(k_hat) else 0.0

    @property
    def is_close(self) -> bool:
        """Whether the polynomials are right where the draws are."""
        is_even = self.weights[1] <= IMPORTANCE_SAMPLING.reliable_k
        return is_even and self.share >= self.least_share and not self.is_cut

    @property
    def is_right(self) -> bool:
        """Whether the draws can be those of the posterior."""
        return self.is_close and self.is_mixed

    def enough(self, simulated: "_Simulated", iterations: int) -> WeightedDraws:
        """Returns as many simulated draws as a posterior needs, or all that were made."""
        settings = RESIDUAL_SURROGATE
        number = math.ceil(IMPORTANCE_SAMPLING.enough_effective / self.share * settings.margin)
        w = self.made[: max(number, len(self.values))]
        further = simulated.values(w[len(self.values) :])
        values = torch.cat((self.values, further))
        smoothed, k_hat = smoothed_weights(values - self.density(w))
        return WeightedDraws.of(w, simulated.space, smoothed, k_hat, iterations)


def _tested(
    simulated: _Simulated, fitted: ResidualSurrogate, reach: float, least_share: float, seed: int
) -> _Tested:
    """Returns draws under polynomials, some of which were simulated.

    Chains are run until they are mixed only where the polynomials are right.
    """
    settings = RESIDUAL_SURROGATE
    density = _posterior(simulated.space, fitted, reach)

    def tested(most_sweeps: int) -> _Tested:
        made, is_mixed = _made(simulated, density, most_sweeps, seed)
        made = made[torch.randperm(len(made), generator=torch.Generator().manual_seed(seed))]
        # Weights do not show what draws are kept from: the outermost ones do.
        farthest = float(fitted.leverage(made).quantile(settings.outermost))
        values = simulated.add(made[: settings.tested])
        return _Tested(made, density, values, is_mixed, farthest > 0.5 * reach, least_share)

    found = tested(settings.fewest_sweeps)
    is_worth_it = found.is_close and not found.is_mixed
    return tested(settings.most_sweeps) if is_worth_it else found


def _made(
    simulated: _Simulated, density: LogDensity, most_sweeps: int, seed: int
) -> tuple[Tensor, bool]:
    """Returns draws of a density by Markov chains, which begin at simulated points.

    The number of sweeps is doubled until the chains have forgotten where they were after half of
    them. Also returns whether they had within ``most_sweeps``.
    """
    settings = RESIDUAL_SURROGATE
    # The points of the fit are among those where the polynomials are known.
    is_known = density(simulated.w).isfinite()
    w, known = simulated.w[is_known], simulated.log_density[is_known]
    # If few points have most of the weight, chains begin at more of them.
    exponent = longest_step(known, 1.0, settings.even_share)
    with seeded(seed, "first"):
        w = w[systematic(exponent * known, settings.num_walkers)]
    generator = torch.Generator().manual_seed(seed)

    def moved(w: Tensor, sweeps: int) -> Tensor:
        return ensemble_draws(density, w, sweeps=sweeps, interval=sweeps, generator=generator)

    sweeps = settings.fewest_sweeps // 2
    w = moved(w, sweeps)
    while True:
        between = moved(w, sweeps // 2)
        last = moved(between, sweeps - sweeps // 2)
        is_mixed = _correlation(w, last) < settings.most_correlated
        if is_mixed or 4 * sweeps > most_sweeps:
            return torch.cat((between, last)), is_mixed
        w, sweeps = last, 2 * sweeps


def _correlation(w: Tensor, later: Tensor) -> float:
    """Returns the greatest correlation of a coordinate of chains with that at a later time."""
    first, second = (each - each.mean(0) for each in (w, later))
    both = (first.square().sum(0) * second.square().sum(0)).sqrt()
    return float(((first * second).sum(0) / both.clamp_min(1e-300)).max())
