"""Permutation tests: the distribution of the largest statistic when nothing is missing.

It includes everything that inflates a naive p-value: parameters and initial states that were
fitted to the same data, correlation of measurements within a segment, outliers, a wrong scale, and
the search over a hundred candidates. If nothing is missing, the residuals of a segment are
unrelated to the change that an effect would have caused there. So the residuals are permuted:
every segment gets the residuals of another one, with a random sign. The largest of all candidates'
statistics is recorded (a permutation test with Westfall and Young's maximum, 1993).

Fast segments have larger residuals, so residuals are first scaled by each segment's own spread.
Coloured noise and the smoother's windows reach across a boundary, so neighbours stay together as
long as there are enough.

If an effect is missing, the permuted residuals contain it, and its own size would hide it. So no
segment keeps its own residuals. The variance of a permutation's score is that of the residuals
after the candidate is fitted to the permutation.
"""

import math
from collections.abc import Iterable, Iterator

import numpy as np
import torch
from scipy import special
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import PERMUTATION_TEST

__all__ = ["LargestStatistic", "block_sums"]


def block_sums(by_segment: Tensor) -> Tensor:
    """Adds the terms of neighbouring segments in pairs, ``(S, P)`` to ``(blocks, P)``."""
    if len(by_segment) < 2 * PERMUTATION_TEST.least_blocks:
        return by_segment
    even = len(by_segment) - len(by_segment) % 2
    joined = by_segment[:even].unflatten(0, (-1, 2)).sum(1)
    return torch.cat((joined, by_segment[even:]))


class LargestStatistic:
    """Compares candidates' statistics with the largest that occurs by chance.

    Args:
        projection: The fitted hypothesis.
        seed: Seed of the permutations.
        draws: Number of permutations; the first is the observed order.
    """

    def __init__(
        self, projection: Projection, *, seed: int, draws: int = PERMUTATION_TEST.num_permutations
    ) -> None:
        self._projection = projection
        residual = projection.whitened(projection.residual[..., None])[..., 0]
        width = max(1, -(-len(residual) // PERMUTATION_TEST.most_blocks))
        if len(residual) >= 2 * PERMUTATION_TEST.least_blocks:
            width = max(2, width)
        self._blocks = len(residual) // width
        self._num_used = self._blocks * width
        used = residual[: self._num_used]
        square = used.square().mean(-1)
        spread = (0.5 * (square + square.mean())).sqrt().clamp_min(1e-30)
        self._spread = spread[:, None, None]
        self._standard = self._joined(used[..., None] / self._spread)[..., 0]
        generator = torch.Generator().manual_seed(seed)
        order = _derangements(draws, self._blocks, generator)
        signs = torch.randint(0, 2, order.shape, generator=generator).double() * 2.0 - 1.0
        order[0], signs[0] = torch.arange(self._blocks), 1.0
        # Index of each block and the block whose residuals it gets, (draws, blocks · blocks).
        entries = torch.arange(self._blocks) * self._blocks + order
        rows = torch.arange(draws).repeat_interleave(self._blocks)
        self._deals = torch.sparse_coo_tensor(
            torch.stack((rows, entries.flatten())),
            signs.flatten(),
            (draws, self._blocks**2),
            check_invariants=True,
        ).coalesce()

    def p_values(self, groups: Iterable[Tensor]) -> list[float]:
        """Returns each candidate's p-value among all of them.

        Args:
            groups: Changes of each candidate, ``(S, N, k)``; only a few are in memory at a time.
        """
        observed: dict[int, float] = {}
        largest = torch.zeros(len(self._deals), dtype=torch.float64)
        for places, alike in _in_batches(groups):
            tails = self._tails(torch.stack(alike, dim=-2))
            largest = largest.maximum(tails.amax(0))
            observed |= dict(zip(places, tails[:, 0].tolist(), strict=True))
        own = torch.tensor(
            [observed[place] for place in range(len(observed))], dtype=torch.float64
        )
        return (largest >= own[:, None] - 1e-12).double().mean(1).tolist()

    def _tails(self, columns: Tensor) -> Tensor:
        """Returns minus the log tail of each candidate's statistic by permutation, ``(P, draws)``.

        Args:
            columns: Changes of P candidates with k strengths each, ``(S, N, P, k)``.
        """
        _, _, num, size = columns.shape
        changes = self._projection.projected(columns.flatten(-2))[: self._num_used]
        weights, signals = (
            self._joined(by_segment).unflatten(-1, (num, size))
            for by_segment in (changes * self._spread, changes / self._spread)
        )
        # Score of block b with the residuals of block c, (P, b, c, k), standardised.
        scores = torch.einsum("bnpk,cn->pbck", weights, self._standard)
        scale = (scores.square().sum((1, 2)) / self._blocks).clamp_min(1e-300).sqrt()
        scores, weights = scores / scale[:, None, None], weights / scale
        # Score of block b with the change of each strength in block c, (P, b, c, k, strength).
        signals = signals / signals.square().sum((0, 1)).clamp_min(1e-300).sqrt()
        expected = torch.einsum("bnpk,cnpl->pbckl", weights, signals)
        covariance = torch.einsum("pbci,pbcj->pij", scores, scores) / self._blocks
        towards = torch.einsum("pbckl,pbek->pcel", expected, scores)
        permuted = self._permuted(torch.cat((scores, towards), dim=-1))
        total, aligned = permuted[..., :size], permuted[..., size:]
        inverse = torch.linalg.pinv(covariance, hermitian=True)
        direction = total @ inverse  # (P, draws, k)
        statistic = (direction * total).sum(-1)
        # Strengths by least squares over all pairs of blocks, and the variance that they explain
        # along the direction of the score.
        pairs = torch.einsum("pbckl,pbckm->plm", expected, expected)
        strengths = aligned @ torch.linalg.pinv(pairs, hermitian=True)
        both = torch.einsum("pdk,pdl->pdkl", direction, strengths).flatten(-2)
        gram = expected.flatten(-2).flatten(1, 2)
        taken = ((both @ (gram.mT @ gram)) * both).sum(-1) / self._blocks
        left = (1.0 - taken / statistic.clamp_min(1e-300)).clamp_min(1e-6)
        return _log_tail(statistic / left, size, self._blocks - size)

    def _permuted(self, table: Tensor) -> Tensor:
        """Returns a table's sums in every permutation, ``(P, b, c, Q)`` to ``(P, draws, Q)``."""
        rows = table.permute(1, 2, 0, 3).flatten(0, 1).flatten(1)
        return torch.sparse.mm(self._deals, rows).unflatten(1, table.shape[::3]).transpose(0, 1)

    def _joined(self, by_segment: Tensor) -> Tensor:
        """Joins neighbouring segments, ``(S, N, P)`` to ``(blocks, N', P)``."""
        return by_segment.unflatten(0, (self._blocks, -1)).flatten(1, 2)


def _in_batches(groups: Iterable[Tensor]) -> Iterator[tuple[list[int], list[Tensor]]]:
    """Yields places and changes of candidates with equal numbers of strengths, in batches."""
    waiting: dict[int, tuple[list[int], list[Tensor]]] = {}
    for place, group in enumerate(groups):
        size = group.shape[-1]
        places, alike = waiting.setdefault(size, ([], []))
        places.append(place)
        alike.append(group)
        if (len(alike) + 1) * group.numel() > PERMUTATION_TEST.numbers_per_part:
            yield waiting.pop(size)
    yield from waiting.values()


def _derangements(draws: int, size: int, generator: torch.Generator) -> Tensor:
    """Returns random permutations without a fixed point, ``(draws, size)``."""
    found: list[Tensor] = []
    while sum(map(len, found)) < draws:
        # A share of 1/e has no fixed point.
        order = torch.rand(3 * draws, size, generator=generator).argsort(-1)
        found.append(order[(order != torch.arange(size)).all(-1)])
    return torch.cat(found)[:draws]


def _log_tail(statistic: Tensor, size: int, freedom: int) -> Tensor:
    """Returns minus the log probability that Hotelling's statistic is greater."""
    halves = 0.5 * freedom, 0.5 * size
    share = freedom / (freedom + statistic.clamp_min(0.0).numpy())
    tail = special.betainc(*halves, share)
    # Where the function underflows, its leading term is used.
    far = halves[0] * np.log(share) - math.log(halves[0]) - special.betaln(*halves)
    return torch.from_numpy(-np.where(tail > 1e-290, np.log(tail.clip(1e-300)), far))
