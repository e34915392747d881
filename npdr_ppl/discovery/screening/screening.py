"""Screening: every candidate's linear gain, in its best shape and size.

A candidate's gain is the reduction of the misfit by its strengths, which are fitted together with
all parameters and the initial states. Whether the gain is larger than chance explains is tested in
:mod:`npdr_ppl.discovery.screening.permutation_tests`.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection, Scores
from npdr_ppl.discovery.screening.sensitivities import Variant

__all__ = ["Screened", "Screening", "screen", "within_limits"]

DETECTABLE = 5.0
"""Separation above which an effect is detected among a hundred candidates."""


@dataclass(frozen=True)
class Screened:
    """A candidate in its best shape and size.

    Attributes:
        variant: The candidate.
        sizes: Fitted strengths in multiples of the variant's size, ``(k,)``.
        gain: Reduction of the misfit, in units of the measurements' variance.
        separation: Distance ‖(1 − P) S β‖ between the model with and without it, in standard
            deviations.
        absorbed: Share of its change that refitted parameters explain.
        minimum_detectable: Smallest detectable distance from zero strength, in parameter units,
            by strength.
    """

    variant: Variant
    sizes: Tensor
    gain: float
    separation: float
    absorbed: float
    minimum_detectable: dict[str, float]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.variant.effect.name

    def shares_by_channel(self, projection: Projection) -> Tensor:
        """Returns the share of each channel in what the candidate changes, ``(C,)``.

        What initial states and parameters could change as well does not count.

        Args:
            projection: The fitted hypothesis.
        """
        change = projection.projected(self.variant.change) @ self.sizes
        squares = change.square().unflatten(-1, (-1, len(projection.hypothesis.fit.scale)))
        by_channel = squares.sum((0, 1))
        return by_channel / by_channel.sum()

    def without_change(self) -> "Screened":
        """Returns the candidate without its change along the recording, to save memory."""
        nothing = self.variant.change.new_zeros(0)
        return replace(self, variant=replace(self.variant, change=nothing))


class Screening:
    """Ranks candidates, which are added one after another, by their linear gain.

    Args:
        projection: The fitted hypothesis.
    """

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        self._best: dict[str, Screened] = {}

    def add(self, variant: Variant) -> None:
        """Keeps a candidate if no other shape or size of the same effect has a larger gain."""
        scores = self._projection.scores(variant.change)
        sizes, gain = within_limits(scores.information, scores.score, (variant,))
        if gain <= 0.0:
            return
        name = variant.effect.name
        if name not in self._best or gain > self._best[name].gain:
            separation = float(sizes @ scores.information @ sizes) ** 0.5
            self._best[name] = Screened(
                variant,
                sizes,
                gain,
                separation,
                float(scores.absorbed.max()),
                _minimum_detectable(scores, variant),
            )

    def ranking(self) -> list[Screened]:
        """Returns the best shape and size of each effect, the largest gain first."""
        return sorted(self._best.values(), key=lambda s: (-s.gain, s.name))


def screen(projection: Projection, variants: Iterable[Variant]) -> list[Screened]:
    """Returns the best shape and size of each effect, the largest linear gain first.

    Args:
        projection: The fitted hypothesis.
        variants: The candidates' sensitivities.
    """
    screening = Screening(projection)
    for variant in variants:
        screening.add(variant)
    return screening.ranking()


def within_limits(
    information: Tensor, score: Tensor, variants: Sequence[Variant]
) -> tuple[Tensor, float]:
    """Returns the sizes with the largest gain that the priors allow, and the gain.

    If the best sizes are outside the limits, every choice of sizes that are at a limit is tried,
    and the others are fitted. This is fast, because there are few strengths.

    Args:
        information: Information of all strengths, ``(k, k)``.
        score: Their scores, ``(k,)``.
        variants: The candidates that have these strengths, in order.
    """
    deviation = torch.cat([variant.deviation for variant in variants])
    lower = torch.cat([variant.lower for variant in variants])
    upper = torch.cat([variant.upper for variant in variants])
    information = information + deviation.square().reciprocal().diag()
    num = len(score)
    best, gain = torch.zeros(num, dtype=torch.float64), 0.0
    # The first choice has no size at a limit.
    for states in itertools.product((0, 1, 2), repeat=num):
        sizes = torch.zeros(num, dtype=torch.float64)
        fixed = [k for k in range(num) if states[k]]
        for k in fixed:
            sizes[k] = lower[k] if states[k] == 1 else upper[k]
        if not bool(sizes.isfinite().all()):
            continue
        free = [k for k in range(num) if not states[k]]
        if free:
            rest = (score - information @ sizes)[free]
            sizes[free] = torch.linalg.solve(information[free][:, free], rest)
        if bool(((sizes < lower - 1e-9) | (sizes > upper + 1e-9)).any()):
            continue
        found = float(2.0 * score @ sizes - sizes @ information @ sizes)
        if found > gain:
            best, gain = sizes, found
        if not fixed:
            break  # it is the largest of all
    return best, gain


def _minimum_detectable(scores: Scores, variant: Variant) -> dict[str, float]:
    sizes = DETECTABLE / scores.information.diagonal().clamp_min(1e-30).sqrt()
    return {
        name: float(sizes[k]) * abs(variant.values[name] - float(variant.nominal[k]))
        for k, name in enumerate(variant.strengths)
    }
