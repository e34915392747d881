"""Linear gains of two candidates together.

Two effects at one place can look like a third one: the single candidate that explains most then
stands for both, and what it leaves belongs to neither. Their joint gain shows them, because the
strengths of both are fitted together with all parameters and the initial states.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import Screened, within_limits
from npdr_ppl.language.effects import Effect

__all__ = ["Pair", "ranked_pairs"]


@dataclass(frozen=True)
class Pair:
    """Two candidates, each in the shape that is best for it alone.

    Attributes:
        members: The candidates.
        sizes: Fitted strengths of each, in multiples of the variant's size, ``(k,)``.
        gain: Reduction of the misfit by both, in units of the measurements' variance.
    """

    members: tuple[Screened, Screened]
    sizes: tuple[Tensor, Tensor]
    gain: float

    @property
    def name(self) -> str:
        """Names of both effects in one text."""
        return " and ".join(member.name for member in self.members)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Both effects."""
        return tuple(member.variant.effect for member in self.members)

    @property
    def names(self) -> frozenset[str]:
        """Names of both effects."""
        return frozenset(member.name for member in self.members)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The fitted parameters of both effects, by site name."""
        return {
            name: value
            for member, own in zip(self.members, self.sizes, strict=True)
            for name, value in member.variant.parameters(own).items()
        }


def ranked_pairs(projection: Projection, candidates: Sequence[Screened]) -> list[Pair]:
    """Returns the pairs of which both get a strength in their joint fit, the largest gain first.

    Args:
        projection: The fitted hypothesis.
        candidates: The candidates, with their changes along the recording.
    """
    if len(candidates) < 2:
        return []
    variants = [candidate.variant for candidate in candidates]
    scores = projection.scores(torch.cat([v.change for v in variants], dim=-1))
    num_strengths = [len(variant.strengths) for variant in variants]
    columns = torch.arange(sum(num_strengths)).split(num_strengths)
    score, information = scores.score, scores.information
    bare = [candidate.without_change() for candidate in candidates]
    pairs = []
    for i, j in itertools.combinations(range(len(candidates)), 2):
        both = torch.cat((columns[i], columns[j]))
        sizes, gain = within_limits(
            information[both][:, both], score[both], (variants[i], variants[j])
        )
        one, other = sizes.split((num_strengths[i], num_strengths[j]))
        if bool(one.any()) and bool(other.any()):
            pairs.append(Pair((bare[i], bare[j]), (one, other), gain))
    return sorted(pairs, key=lambda pair: (-pair.gain, sorted(pair.names)))
