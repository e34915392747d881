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
from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor
from torch.nn.functional import pad

from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import ForceChange, PulseChanges
from npdr_ppl.discovery.screening.settings import PERMUTATION_TEST
from npdr_ppl.memory import release_freed_memory

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
        self._bases: dict[PulseChanges, _Along] = {}
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

    def p_values(self, groups: Iterable[Tensor | ForceChange]) -> list[float]:
        """Returns each candidate's p-value among all of them.

        Args:
            groups: Changes of each candidate, ``(S, N, k)``, or laws of force; only a few are in
                memory at a time.
        """
        places_by_size: dict[int, list[int]] = {}
        observed: dict[int, list[Tensor]] = {}
        largest: dict[int, Tensor] = {}
        for number, (places, changes, standard) in enumerate(self._in_batches(groups)):
            if number % PERMUTATION_TEST.batches_per_release == 0:
                release_freed_memory()
            size = changes.shape[-1]
            statistics = self._statistics(changes, standard)
            # The tail probability decreases with the statistic, so only the largest is needed.
            most = statistics.amax(0)
            largest[size] = most.maximum(largest.get(size, most))
            # A copy: a view would keep the statistics of all permutations.
            observed.setdefault(size, []).append(statistics[:, 0].clone())
            places_by_size.setdefault(size, []).extend(places)
        tails = torch.zeros(len(self._deals), dtype=torch.float64)
        for size, statistics in largest.items():
            tails = tails.maximum(self._log_tail(statistics, size))
        tails = tails.sort().values
        values: dict[int, float] = {}
        for size, places in places_by_size.items():
            own = self._log_tail(torch.cat(observed[size]), size)
            num = len(tails) - torch.searchsorted(tails, own - 1e-12)
            values |= dict(zip(places, (num.double() / len(tails)).tolist(), strict=True))
        return [values[place] for place in range(len(values))]

    def _in_batches(
        self, groups: Iterable[Tensor | ForceChange]
    ) -> Iterator[tuple[list[int], Tensor, Tensor]]:
        """Yields candidates that are tested together: those with equal numbers of strengths.

        Yields:
            Their places, their projected changes in the segments that are used, ``(S, N, P, k)``,
            and the standardised residuals of each block in the same coordinates.
        """
        waiting: dict[tuple[PulseChanges | None, int], tuple[list[int], list[Tensor]]] = {}
        for place, group in enumerate(groups):
            pulses, given = (
                (group.pulses, group.values) if isinstance(group, ForceChange) else (None, group)
            )
            size = given.shape[-1]
            places, alike = waiting.setdefault((pulses, size), ([], []))
            places.append(place)
            alike.append(given)
            coordinates = given[..., 0].numel() if pulses is None else self._along(pulses).size
            numbers = max(coordinates, len(self._deals)) * size
            if (len(alike) + 1) * numbers > PERMUTATION_TEST.numbers_per_part:
                del waiting[pulses, size]
                yield places, *self._projected(pulses, alike)
        for (pulses, _), (places, alike) in waiting.items():
            yield places, *self._projected(pulses, alike)

    def _projected(
        self, pulses: PulseChanges | None, alike: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Returns projected changes, ``(S, N, P, k)``, and residuals in the same coordinates."""
        given = torch.stack(alike, dim=-2)
        columns, shape = given.flatten(-2), given.shape[-2:]
        if pulses is None:
            changes = self._projection.projected(columns)[: self._num_used]
            return changes.unflatten(-1, shape), self._standard
        along = self._along(pulses)
        changes = along.columns @ pulses.weights(columns)[: self._num_used]
        return changes.unflatten(-1, shape), along.standard

    def _along(self, pulses: PulseChanges) -> "_Along":
        """Returns a port's columns in a basis with few elements; computed once."""
        if pulses not in self._bases:
            columns = pulses.columns[: self._num_used].unflatten(0, (self._blocks, -1))
            standard = self._standard.unflatten(-1, columns.shape[1:3])
            parts = [_in_span(columns[:, j], standard[:, j]) for j in range(columns.shape[1])]
            most = max(r.shape[1] for _, r in parts)
            turned = torch.stack([pad(c, (0, 0, 0, most - c.shape[1])) for c, _ in parts], 1)
            residuals = torch.stack([pad(r, (0, most - r.shape[1])) for _, r in parts], 1)
            self._bases[pulses] = _Along(turned.flatten(0, 1), residuals.flatten(1))
        return self._bases[pulses]

    def _log_tail(self, statistics: Tensor, size: int) -> Tensor:
        return _log_tail(statistics, size, self._blocks - size)

    def _statistics(self, changes: Tensor, standard: Tensor) -> Tensor:
        """Returns Hotelling's statistic of each candidate by permutation, ``(P, draws)``.

        Args:
            changes: Projected changes of P candidates with k strengths, ``(S, N, P, k)``.
            standard: Standardised residuals of each block in the same coordinates.
        """
        size = changes.shape[-1]
        scores, expected = self._scores(changes, standard)
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
        return statistic / left

    def _scores(self, changes: Tensor, standard: Tensor) -> tuple[Tensor, Tensor]:
        """Returns what each block's changes explain of the residuals and changes of another one.

        Within a block, each segment is weighted by its own spread.

        Args:
            changes: See :meth:`_statistics`.
            standard: See :meth:`_statistics`.

        Returns:
            Score of block b with the residuals of block c, ``(P, b, c, k)``, standardised; and
            with the change of each strength in block c, ``(P, b, c, k, strength)``.
        """
        blocks, size = self._blocks, changes.shape[-1]
        # One copy in the order of the products: (segment of the block, P, b · k, N).
        by_place = changes.unflatten(0, (blocks, -1)).permute(1, 3, 0, 4, 2)
        by_place = by_place.reshape(*by_place.shape[:2], blocks * size, -1)
        residual = standard.unflatten(-1, (len(by_place), -1)).permute(1, 2, 0)  # (j, N, c)
        spread = self._spread.reshape(blocks, -1).mT.repeat_interleave(size, 1)  # (j, b · k)
        own = (by_place.flatten(1, 2) @ residual).unflatten(1, (-1, blocks * size))
        own = (spread[:, None, :, None] * own).sum(0)
        scores = own.unflatten(1, (blocks, size)).transpose(2, 3)
        matrices = by_place.flatten(0, 1)  # products of more dimensions would copy the transpose
        products = (matrices @ matrices.mT).unflatten(0, by_place.shape[:2])  # (j, P, b k, c k)
        ratios = spread[:, None, :, None] / spread[:, None, None]
        expected = (ratios * products).sum(0).unflatten(2, (blocks, size))
        expected = expected.unflatten(1, (blocks, size)).transpose(2, 3)
        squares = products.diagonal(dim1=-2, dim2=-1) / spread.square()[:, None]
        length = squares.sum(0).unflatten(1, (blocks, size)).sum(1).clamp_min(1e-300).sqrt()
        scale = (scores.square().sum((1, 2)) / blocks).clamp_min(1e-300).sqrt()
        expected = expected / scale[:, None, None, :, None] / length[:, None, None, None]
        return scores / scale[:, None, None], expected

    def _permuted(self, table: Tensor) -> Tensor:
        """Returns a table's sums in every permutation, ``(P, b, c, Q)`` to ``(P, draws, Q)``."""
        rows = table.permute(1, 2, 0, 3).flatten(0, 1).flatten(1)
        return torch.sparse.mm(self._deals, rows).unflatten(1, table.shape[::3]).transpose(0, 1)

    def _joined(self, by_segment: Tensor) -> Tensor:
        """Joins neighbouring segments, ``(S, N, P)`` to ``(blocks, N', P)``."""
        return by_segment.unflatten(0, (self._blocks, -1)).flatten(1, 2)


@dataclass(frozen=True)
class _Along:
    """The changes that forces at a port can cause, in an orthonormal basis of their span.

    Attributes:
        columns: The columns of :class:`PulseChanges` in the segments that are used, ``(S, n, c)``.
        standard: Standardised residuals of each block, as far as they lie in the span.
    """

    columns: Tensor
    standard: Tensor

    @property
    def size(self) -> int:
        """Number of coordinates of all segments."""
        return self.columns[..., 0].numel()


def _in_span(columns: Tensor, residuals: Tensor) -> tuple[Tensor, Tensor]:
    """Returns vectors in an orthonormal basis of the span of all columns.

    What lies outside the basis is smaller than each column by ``PERMUTATION_TEST.lost_in_span``.
    Responses to forces are smooth, so that far fewer elements than measurements suffice. If they
    do not, both are returned unchanged.

    Args:
        columns: Columns of each block, ``(blocks, N, c)``.
        residuals: Residuals of each block, ``(blocks, N)``.

    Returns:
        The columns, ``(blocks, n, c)``, and the residuals, ``(blocks, n)``.
    """
    size = columns.square().sum((0, 1)).sqrt().clamp_min(1e-150)  # parameters differ in size
    spanned = (columns / size).transpose(0, 1).flatten(1)  # (N, blocks · c)
    most = PERMUTATION_TEST.most_in_span
    basis = None
    if min(spanned.shape) > 2 * most:
        basis = _sketched(spanned)
    if basis is None and spanned.shape[1] < len(spanned):
        basis = torch.linalg.qr(spanned)[0]
    if basis is None:
        return columns, residuals
    return torch.einsum("bnc,nk->bkc", columns, basis), residuals @ basis


def _sketched(spanned: Tensor) -> Tensor | None:
    """Returns a basis of nearly all that columns span, ``None`` if it would have to be large.

    It is found from a random sketch (Halko, Martinsson & Tropp 2011).

    Args:
        spanned: The columns, ``(N, n)``.
    """
    generator, most = torch.Generator().manual_seed(0), PERMUTATION_TEST.most_in_span
    directions = torch.randn(spanned.shape[1], most, generator=generator, dtype=torch.float64)
    basis = torch.linalg.qr(spanned @ directions)[0]
    inside = basis.mT @ spanned
    values, vectors = torch.linalg.eigh(inside @ inside.mT)
    # Squares of all columns together, of which each has at most one.
    outside = float(spanned.square().sum() - values.sum())
    if outside > PERMUTATION_TEST.lost_in_span**2:
        return None
    return basis @ vectors[:, outside + values.cumsum(0) > PERMUTATION_TEST.lost_in_span**2]


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
