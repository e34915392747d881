"""Screening: every candidate's linear gain, and whether chance explains it.

A candidate's gain is how far its strengths, fitted together with all parameters and the initial
states, reduce the misfit. Whether that is more than chance can do is judged by the score test
with the variance of the segments' own scatter, over all candidates at once: signs of whole
segments are drawn at random (the wild bootstrap, Wu 1986; Davidson & Flachaire 2008), which keeps
everything but the sign that an effect would give them, and the largest statistic of all candidates
is compared with the one observed. That counts how many candidates were tried and how alike they
are, and it does not mind coloured noise, outliers, or a wrong scale.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.workflows.discovery.projection import Projection, Scores
from npdr_ppl.workflows.discovery.sensitivities import Variant

__all__ = ["Screened", "block_scores", "largest_statistic_p_value", "screen"]

DETECTABLE = 5.0
"""Separation from which an effect shows among a hundred candidates."""

SIGN_DRAWS = 2000
"""Draws of signs; a p-value is at least one in as many."""

FEWEST_BLOCKS = 24
"""Neighbouring segments are joined in pairs as long as this many blocks remain, because the
readings that the smoother saw overlap."""


@dataclass(frozen=True)
class Screened:
    """A candidate in its best shape and size.

    Attributes:
        variant: The candidate.
        sizes: Fitted strengths in sizes, ``(k,)``.
        gain: Reduction of the misfit, in units of the readings' variance.
        separation: Distance ‖(1 − P) S β‖ between the model with and without it, in standard
            deviations.
        absorbed: Share of its change that refitted parameters explain.
        statistic: Score statistic, chi-square with k degrees of freedom by chance.
        p_value: Probability of as large a statistic by chance, for this candidate alone.
        minimum_detectable: Distance from none in parameter units at which it would show, by
            strength.
    """

    variant: Variant
    sizes: Tensor
    gain: float
    separation: float
    absorbed: float
    statistic: float
    p_value: float
    minimum_detectable: dict[str, float]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.variant.effect.name


def screen(projection: Projection, variants: Sequence[Variant]) -> list[Screened]:
    """Ranks candidates by their linear gain, the best shape and size of each effect.

    Args:
        projection: The fitted hypothesis.
        variants: The candidates' sensitivities.
    """
    best: dict[str, Screened] = {}
    for variant in variants:
        scores = projection.scores(variant.change)
        sizes, gain = _within_limits(scores, variant)
        if gain <= 0.0:
            continue
        name = variant.effect.name
        if name not in best or gain > best[name].gain:
            statistic = _statistic(scores)
            separation = float(sizes @ scores.information @ sizes) ** 0.5
            chance = torch.distributions.Chi2(float(len(sizes))).cdf(statistic)
            best[name] = Screened(
                variant,
                sizes,
                gain,
                separation,
                float(scores.absorbed.max()),
                float(statistic),
                float(1.0 - chance),
                _minimum_detectable(scores, variant),
            )
    return sorted(best.values(), key=lambda s: -s.gain)


def block_scores(by_segment: Tensor) -> Tensor:
    """Joins the scores of neighbouring segments, ``(S, P)`` to ``(blocks, P)``."""
    if len(by_segment) < 2 * FEWEST_BLOCKS:
        return by_segment
    even = len(by_segment) - len(by_segment) % 2
    joined = by_segment[:even].unflatten(0, (-1, 2)).sum(1)
    return torch.cat((joined, by_segment[even:]))


def largest_statistic_p_value(
    groups: Sequence[Tensor], *, seed: int, draws: int = SIGN_DRAWS
) -> tuple[float, list[float]]:
    """Returns the p-value of the largest statistic, and of each among all.

    Args:
        groups: Scores by segment of each candidate, ``(S, k)``.
        seed: Seed of the signs.
        draws: Number of draws of signs.
    """
    blocks = [block_scores(group) for group in groups]
    generator = torch.Generator().manual_seed(seed)
    num = len(blocks[0])
    signs = torch.randint(0, 2, (draws, num), generator=generator).double() * 2.0 - 1.0
    signs[0] = 1.0  # what was observed
    statistics = torch.stack(
        [_chance(_signed_statistics(block, signs), block) for block in blocks]
    )
    largest = statistics.amax(0)
    values = [float((largest >= row[0] - 1e-12).double().mean()) for row in statistics]
    return min(values), values


def _signed_statistics(block: Tensor, signs: Tensor) -> Tensor:
    """Returns the statistic under each draw of signs, ``(draws,)``."""
    variance = block.mT @ block
    scale = variance.diagonal().clamp_min(1e-300).sqrt()
    unit = block / scale
    inverse = torch.linalg.pinv(unit.mT @ unit, hermitian=True, rtol=1e-8)
    sums = signs @ unit
    return ((sums @ inverse) * sums).sum(-1)


def _chance(statistic: Tensor, block: Tensor) -> Tensor:
    """Maps statistics of any degrees of freedom to one scale: minus the log of chance's tail."""
    half = torch.tensor(0.5 * block.shape[-1], dtype=torch.float64)
    tail = torch.special.gammaincc(half, 0.5 * statistic)
    return -tail.clamp_min(1e-300).log()


def _statistic(scores: Scores) -> Tensor:
    block = block_scores(scores.by_segment)
    return _signed_statistics(block, torch.ones(1, len(block), dtype=torch.float64))[0]


def _within_limits(scores: Scores, variant: Variant) -> tuple[Tensor, float]:
    """Returns the sizes of greatest gain that the priors admit, and the gain.

    Sizes at a limit stay there and the others are fitted: all choices are tried, there are few
    strengths.
    """
    num = len(variant.strengths)
    precision = variant.deviation.square().reciprocal().diag()
    information, score = scores.information + precision, scores.score
    best, gain = torch.zeros(num, dtype=torch.float64), 0.0
    for states in itertools.product((0, 1, 2), repeat=num):
        sizes = torch.zeros(num, dtype=torch.float64)
        fixed = [k for k in range(num) if states[k]]
        for k in fixed:
            limit = variant.lower[k] if states[k] == 1 else variant.upper[k]
            sizes[k] = limit
        if not bool(sizes.isfinite().all()):
            continue
        free = [k for k in range(num) if not states[k]]
        if free:
            rest = (score - information @ sizes)[free]
            sizes[free] = torch.linalg.solve(information[free][:, free], rest)
        if bool(((sizes < variant.lower - 1e-9) | (sizes > variant.upper + 1e-9)).any()):
            continue
        found = float(2.0 * score @ sizes - sizes @ information @ sizes)
        if found > gain:
            best, gain = sizes, found
    return best, gain


def _minimum_detectable(scores: Scores, variant: Variant) -> dict[str, float]:
    sizes = DETECTABLE / scores.information.diagonal().clamp_min(1e-30).sqrt()
    return {
        name: float(sizes[k]) * abs(variant.values[name] - float(variant.nominal[k]))
        for k, name in enumerate(variant.strengths)
    }
