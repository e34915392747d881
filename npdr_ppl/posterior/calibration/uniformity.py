"""Are ranks uniform? An exact simultaneous test and band for their empirical distribution.

Säilynoja, Bürkner & Vehtari (2022), *Graphical test for discrete uniformity and its applications
in goodness-of-fit evaluation and multiple sample comparison*,
https://doi.org/10.1007/s11222-022-10090-6.

With N ranks, each uniform on 0 … L, the number R_k of ranks below a threshold m_k is binomial,
R_k ~ Bin(N, t_k) with t_k = m_k / (L + 1). Its pointwise tail probability is

    g_k(R) = 2 min(F_k(R), 1 - F_k(R - 1)),

with F_k the binomial distribution function, and the statistic is the least of them, min_k g_k.
From one threshold to the next R_k moves as a Markov chain with binomial steps, so that
P(min_k g_k > g) is a product of matrices (the optimisation-based variant of their method):
p-values and bands are exact, without simulation and without large-sample approximation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import binom

from npdr_ppl.errors import ShapeError

__all__ = ["Band", "simultaneous_band", "uniformity_p_value"]

MAX_POINTS = 100
"""Greatest number of thresholds at which the distribution is tested. They are one per cent apart,
which is as fine as some hundred data sets can resolve."""

SMALLEST_STATISTIC = 1e-10
"""Statistic below which the p-value is replaced by its upper bound, thresholds × statistic. The
exact value would be lost in rounding errors and cost N² operations per threshold."""


@dataclass(frozen=True)
class Band:
    """A band that the empirical distribution of uniform ranks leaves with a given probability.

    Attributes:
        positions: Fractions t_k of the ranks' range, ``(K,)``.
        low: Least share of ranks below each position, ``(K,)``.
        high: Greatest share, ``(K,)``.
    """

    positions: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def uniformity_p_value(ranks: NDArray[np.int64], num_draws: int) -> float:
    """Returns the p-value of the hypothesis that ranks are independent and uniform on 0 … L.

    Args:
        ranks: Ranks, ``(N,)``.
        num_draws: Greatest rank L.

    Raises:
        ShapeError: There are no ranks, or one lies outside 0 … L.
    """
    if ranks.ndim != 1 or not len(ranks) or ranks.min() < 0 or ranks.max() > num_draws:
        raise ShapeError(
            f"Expected a vector of ranks between 0 and {num_draws}, got {ranks.shape=}."
        )
    thresholds = _thresholds(len(ranks), num_draws)
    t = thresholds / (num_draws + 1)
    counts = np.searchsorted(np.sort(ranks), thresholds)
    statistic = float(_tail_probability(counts, len(ranks), t).min())
    if statistic < SMALLEST_STATISTIC:
        return min(1.0, statistic * len(t))
    # Counts as improbable as the one seen belong to the tail; the factor absorbs rounding.
    return 1.0 - _probability_inside(len(ranks), t, statistic * (1 + 1e-9))


def simultaneous_band(num_ranks: int, num_draws: int, probability: float = 0.95) -> Band:
    """Returns the band that all of N uniform ranks' distribution stays in.

    Args:
        num_ranks: Number of ranks N.
        num_draws: Greatest rank L.
        probability: Least probability of staying inside everywhere; counts are discrete, so the
            band may hold a little more.
    """
    t = _thresholds(num_ranks, num_draws) / (num_draws + 1)
    # A pointwise level of 1 - probability is too much, one of that over K (Bonferroni) enough.
    low, high = (1 - probability) / len(t) / 2, 1 - probability
    while high / low > 1.001:
        middle = float(np.sqrt(low * high))
        if _probability_inside(num_ranks, t, middle) >= probability:
            low = middle
        else:
            high = middle
    first, last = _interval(num_ranks, t, low)
    return Band(t, first / num_ranks, last / num_ranks)


def _thresholds(num_ranks: int, num_draws: int) -> NDArray[np.int64]:
    """Returns the thresholds m_k, integers so that no rank has to be split between two."""
    num = min(MAX_POINTS, num_ranks, num_draws + 1)
    return np.unique(np.round(np.arange(1, num) / num * (num_draws + 1)).astype(np.int64))


def _tail_probability(
    counts: NDArray[np.int64], num_ranks: int, t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns g_k at counts R_k."""
    below = binom.cdf(counts, num_ranks, t)
    above = binom.sf(counts - 1, num_ranks, t)
    return 2 * np.minimum(below, above)


def _interval(
    num_ranks: int, t: NDArray[np.float64], statistic: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the least and greatest count at each threshold whose g_k exceeds the statistic."""
    counts = np.arange(num_ranks + 1)
    inside = _tail_probability(counts[None], num_ranks, t[:, None]) > statistic
    return inside.argmax(1), num_ranks - inside[:, ::-1].argmax(1)


def _probability_inside(num_ranks: int, t: NDArray[np.float64], statistic: float) -> float:
    """Returns P(min_k g_k > statistic)."""
    first, last = _interval(num_ranks, t, statistic)
    log_factorial = gammaln(np.arange(num_ranks + 1) + 1.0)
    before, mass, at = np.array([0]), np.array([1.0]), 0.0
    for low, high, position in zip(first, last, t, strict=True):
        if not _tail_probability(np.array([low]), num_ranks, np.array([position])) > statistic:
            return 0.0  # no count at all is probable enough
        after = np.arange(low, high + 1)
        step = (position - at) / (1 - at)
        left, moved = num_ranks - before[:, None], after - before[:, None]
        possible = (moved >= 0) & (moved <= left)
        moved = np.where(possible, moved, 0)
        log_probability = (
            log_factorial[left] - log_factorial[moved] - log_factorial[left - moved]
        ) + moved * np.log(step) + (left - moved) * np.log1p(-step)  # fmt: skip
        mass = mass @ np.where(possible, np.exp(log_probability), 0.0)
        before, at = after, position
    return float(min(mass.sum(), 1.0))
