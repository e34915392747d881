"""What chance can do: the distribution of the largest statistic when nothing is missing.

Everything that inflates a naive p-value is part of it: the parameters and initial states that were
fitted to the same data, the readings' correlation within a segment, outliers, a wrong scale, and
the search over a hundred candidates. Under the hypothesis that nothing is missing, the residuals
of a segment have nothing to do with what an effect would have done there. So they are dealt out
anew: every segment gets the residuals of another one, with a random sign, and the largest of all
candidates' statistics is noted (a permutation test with Westfall and Young's maximum, 1993).
Residuals are scaled by each segment's own spread before they are dealt, since fast segments have
larger ones, and neighbours go together as long as there are enough, since coloured noise and the
smoother's windows reach across a boundary.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.workflows.discovery.projection import Projection

__all__ = ["FEWEST_BLOCKS", "LargestStatistic", "block_sums"]

DRAWS = 2000
"""Deals; a p-value is at least one in as many."""

FEWEST_BLOCKS = 24
"""Neighbouring segments are joined in pairs as long as this many pairs remain."""

MOST_NUMBERS = 20_000_000
"""Numbers held at a time."""


def block_sums(by_segment: Tensor) -> Tensor:
    """Joins the terms of neighbouring segments, ``(S, P)`` to ``(blocks, P)``."""
    if len(by_segment) < 2 * FEWEST_BLOCKS:
        return by_segment
    even = len(by_segment) - len(by_segment) % 2
    joined = by_segment[:even].unflatten(0, (-1, 2)).sum(1)
    return torch.cat((joined, by_segment[even:]))


class LargestStatistic:
    """Compares candidates' statistics with the largest that chance gives.

    Args:
        projection: The fitted hypothesis.
        seed: Seed of the deals.
        draws: Number of deals; the first is what was observed.
    """

    def __init__(self, projection: Projection, *, seed: int, draws: int = DRAWS) -> None:
        self._projection = projection
        residual = projection.weighted_residual
        num = len(residual)
        width = 2 if num >= 2 * FEWEST_BLOCKS else 1
        num_used = num - num % width
        square = residual[:num_used].square().mean(-1)
        spread = (0.5 * (square + square.mean())).sqrt().clamp_min(1e-30)
        standard = residual[:num_used] / spread[:, None]
        blocks = num_used // width
        generator = torch.Generator().manual_seed(seed)
        order = torch.rand(draws, blocks, generator=generator).argsort(-1)
        signs = torch.randint(0, 2, (draws, blocks), generator=generator).double() * 2.0 - 1.0
        order[0], signs[0] = torch.arange(blocks), 1.0
        # The entry of every block and what it is dealt, (draws, blocks · blocks).
        entries = torch.arange(blocks) * blocks + order
        places = torch.stack((torch.arange(draws).repeat_interleave(blocks), entries.flatten()))
        shape = draws, blocks * blocks
        self._deals = torch.sparse_coo_tensor(
            places, signs.flatten(), shape, check_invariants=True
        ).coalesce()
        self._dealt: list[tuple[slice, Tensor, Tensor]] = []
        for k in range(width):
            own = slice(k, num_used, width)
            dealt = (spread[own, None, None] * standard[own].mT, own)
            self._dealt.append((own, projection.solve(*dealt), projection.explained(*dealt)))

    def p_values(self, groups: Sequence[Tensor]) -> list[float]:
        """Returns each candidate's p-value among all of them.

        Args:
            groups: Changes of each candidate, ``(S, N, k)``.
        """
        rows: list[Tensor] = []
        limit = max(1, MOST_NUMBERS // self._deals.shape[1])
        waiting: list[Tensor] = []
        for group in groups:
            if waiting and sum(g.shape[-1] for g in waiting) + group.shape[-1] > limit:
                rows += self._statistics(waiting)
                waiting = []
            waiting.append(group)
        if waiting:
            rows += self._statistics(waiting)
        if not rows:
            return []
        largest = torch.stack(rows).amax(0)
        return [float((largest >= row[0] - 1e-12).double().mean()) for row in rows]

    def _statistics(self, groups: list[Tensor]) -> list[Tensor]:
        """Returns minus the log tail of each candidate's statistic in every deal, ``(draws,)``."""
        columns = torch.cat(groups, dim=-1)
        refit = self._projection.refit(columns)
        # What block b would score with the residuals of block b', (blocks, blocks', P).
        table = sum(
            weighted.mT @ columns[own] - explained.mT @ refit
            for own, weighted, explained in self._dealt
        )
        assert isinstance(table, Tensor)
        sums = torch.sparse.mm(self._deals, table.flatten(0, 1))
        result, start = [], 0
        for group in groups:
            own = slice(start, start + group.shape[-1])
            start = own.stop
            terms = table[..., own].flatten(0, 1)
            covariance = terms.mT @ terms / len(table)
            scale = covariance.diagonal().clamp_min(1e-300).sqrt()
            inverse = torch.linalg.pinv(covariance / scale / scale[:, None], hermitian=True)
            unit = sums[:, own] / scale
            statistic = ((unit @ inverse) * unit).sum(-1)
            half = torch.tensor(0.5 * group.shape[-1], dtype=torch.float64)
            tail = torch.special.gammaincc(half, 0.5 * statistic.clamp_min(0.0))
            # Beyond what the function resolves, its leading term goes on.
            far = 0.5 * statistic
            result.append(torch.where(tail > 1e-290, -tail.clamp_min(1e-300).log(), far))
        return result
