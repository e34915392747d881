"""Linear gains of several candidates together.

Two effects at one place can look like a third one: the single candidate that explains most then
stands for both, and what it leaves belongs to neither. Robots also have the same law at many
joints, as friction in every gear. The joint gain of a group shows both, because the strengths of
all members are fitted together with all parameters and the initial states.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import Screened, within_limits
from npdr_ppl.discovery.screening.settings import GROUPS
from npdr_ppl.language.effects import Effect

__all__ = ["Group", "num_counted", "ranked_laws", "ranked_pairs"]


@dataclass(frozen=True)
class Group:
    """Several candidates, each in the shape that is best for it alone.

    Attributes:
        members: The candidates.
        sizes: Fitted strengths of each, in multiples of the variant's size, ``(k,)``.
        gain: Reduction of the misfit by all, in units of the measurements' variance.
    """

    members: tuple[Screened, ...]
    sizes: tuple[Tensor, ...]
    gain: float

    @property
    def name(self) -> str:
        """Names of all effects in one text."""
        return " and ".join(member.name for member in self.members)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects."""
        return tuple(member.variant.effect for member in self.members)

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(member.name for member in self.members)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The fitted parameters of all effects, by site name."""
        return {
            name: value
            for member, own in zip(self.members, self.sizes, strict=True)
            for name, value in member.variant.parameters(own).items()
        }


def num_counted(effects: Iterable[Effect]) -> int:
    """Returns the number of effects, of which the same law at several joints counts as one."""
    numbers = Counter(effect.id for effect in effects)
    return sum(1 if number >= GROUPS.fewest else number for number in numbers.values())


def ranked_pairs(projection: Projection, candidates: Sequence[Screened]) -> list[Group]:
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
            pairs.append(Group((bare[i], bare[j]), (one, other), gain))
    return sorted(pairs, key=lambda pair: (-pair.gain, sorted(pair.names)))


def ranked_laws(projection: Projection, candidates: Sequence[Screened]) -> list[Group]:
    """Returns the same law at several ports of one kind as groups, the largest gain first.

    Members whose strength matters too little are left out one after another, the least first.
    Groups of fewer than ``GROUPS.fewest`` members are left to single effects and pairs.

    Args:
        projection: The fitted hypothesis.
        candidates: The candidates, with their changes along the recording.
    """
    by_law: dict[str, list[Screened]] = {}
    for candidate in candidates:
        effect = candidate.variant.effect
        # A group of channels is one device, not the same law at several.
        if len(effect.channels) == 1 and len(candidate.variant.strengths) == 1:
            by_law.setdefault(effect.id, []).append(candidate)
    laws = []
    for members in by_law.values():
        if len(members) >= GROUPS.fewest:
            group = _with_telling_members(projection, members)
            if len(group.members) >= GROUPS.fewest:
                laws.append(group)
    return sorted(laws, key=lambda group: (-group.gain, group.name))


def _with_telling_members(projection: Projection, members: Sequence[Screened]) -> Group:
    """Returns the members of a law without which the joint gain would be clearly smaller."""
    scores = projection.scores(torch.cat([m.variant.change for m in members], dim=-1))
    kept = list(range(len(members)))
    share = projection.hypothesis.share
    while True:
        sizes, gain = _fitted(scores.information, scores.score, kept, members)
        lost = []
        for k in kept:
            others = [j for j in kept if j != k]
            rest = _fitted(scores.information, scores.score, others, members)[1] if others else 0.0
            lost.append(0.5 * share * (gain - rest))
        least = int(np.argmin(lost))
        if len(kept) == 1 or lost[least] >= GROUPS.least_evidence:
            break
        del kept[least]
    chosen = tuple(members[k].without_change() for k in kept)
    return Group(chosen, tuple(torch.tensor([size]).double() for size in sizes), gain)


def _fitted(
    information: Tensor, score: Tensor, kept: Sequence[int], members: Sequence[Screened]
) -> tuple[list[float], float]:
    """Returns the sizes of some members with the largest gain that the priors allow, and it.

    There are too many for :func:`within_limits`, whose time grows exponentially.
    """
    index = torch.tensor(kept)
    variants = [members[k].variant for k in kept]
    deviation = torch.cat([variant.deviation for variant in variants])
    own = information[index][:, index] + deviation.square().reciprocal().diag()
    factor = torch.linalg.cholesky(own)
    target = torch.linalg.solve_triangular(factor, score[index][:, None], upper=False)[:, 0]
    lower = torch.cat([variant.lower for variant in variants]).numpy()
    upper = torch.cat([variant.upper for variant in variants]).numpy()
    found = lsq_linear(factor.mT.numpy(), target.numpy(), (lower, upper)).x
    sizes = torch.from_numpy(found)
    return sizes.tolist(), float(2.0 * score[index] @ sizes - sizes @ own @ sizes)
