"""Chooses the terms of a law by linear least squares.

The change of the measurements by a law is linear in its coefficients, once the responses to pulses
are known. Coefficients, the model's parameters and the initial states are fitted together; the
initial states are integrated out. So a formula costs the solution of a few equations and no
simulation, and thousands are compared.

A spurious coefficient that is the best of p reduces the misfit by about 2 log p. A beam search
therefore adds that to the misfit for each coefficient, and for what else makes a term complex (the
risk inflation criterion of Foster & George 1994). How many terms are needed is decided by
predicting parts of the recording from the others, with the terms chosen anew without each part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.learning.term import Term
from npdr_ppl.discovery.screening.projection import Projection

__all__ = ["Formula", "NormalEquations", "PortProducts", "pareto_front", "simplest"]

RIDGE = 1e-10
"""Addition to the diagonal of normal equations, as a share of it. It is far above the rounding
errors of sums, 1e-13, and changes what the recording determines by about as small a share."""


_Solved = tuple[tuple[int, ...], Tensor, Tensor]
"""A choice of terms, its columns, and the coefficients of the parameters and the columns."""


@dataclass(frozen=True)
class Formula:
    """A sum of terms at one port.

    Attributes:
        terms: The terms.
        coefficients: One for each column of each term, in order.
        errors: Misfit of each fold, with the same number of terms chosen and fitted without the
            fold, ``(F,)``.
        misfit: Misfit of all.
    """

    terms: tuple[Term, ...]
    coefficients: Tensor
    errors: Tensor
    misfit: float

    @property
    def error(self) -> float:
        """Sum of the errors of all folds."""
        return float(self.errors.sum())

    @property
    def cost(self) -> float:
        """Complexity."""
        return sum(term.cost for term in self.terms)


class PortProducts:
    """Products of the responses at a port, from which those of any term follow.

    Args:
        projection: The fitted model.
        motion: The motion at the port.
        responses: Change of the whitened measurements per unit of each of P laws, ``(S, N, P)``.
    """

    def __init__(self, projection: Projection, motion: PortMotion, responses: Tensor) -> None:
        self.motion = motion
        by_z = projection.whitened_parameters  # (S, N, d)
        responses = projection.whitened(responses)
        residual = projection.whitened(projection.residual[..., None])  # (S, N, 1)
        self.inflation = 1.0 / projection.hypothesis.share
        self.squares = responses.mT @ responses  # (S, P, P)
        self.cross = by_z.mT @ responses  # (S, d, P)
        self.scores = (responses.mT @ residual)[..., 0]  # (S, P)
        self.by_z = by_z.mT @ by_z  # (S, d, d)
        self.z_scores = (by_z.mT @ residual)[..., 0]  # (S, d)
        self.misfits = residual.square().sum((1, 2))  # (S,)

    def equations(self, terms: Sequence[Term], values: Sequence[Tensor]) -> "NormalEquations":
        """Returns the normal equations of terms; those that do not change are left out.

        Args:
            terms: The terms.
            values: The weights of the responses in each term's columns, ``(S, P, k)`` each.
        """
        known, kept, slices, first = [], [], [], 0
        for term, columns in zip(terms, values, strict=True):
            size = columns.square().mean((0, 1)).sqrt()
            if not bool(columns.isfinite().all()) or bool((size <= 1e-12).any()):
                continue
            known.append(columns)
            kept.append(term)
            slices.append(slice(first, first + columns.shape[-1]))
            first += columns.shape[-1]
        empty = torch.zeros(*self.scores.shape, 0, dtype=torch.float64)
        laws = torch.cat([empty, *known], dim=-1)  # (S, P, k)
        sizes = laws.square().mean((0, 1)).sqrt()
        laws = laws / sizes
        d = self.by_z.shape[-1]
        weak = (LEARNING.prior_spread * self.motion.port.rated) ** -2
        precision = torch.full((d + first,), weak, dtype=torch.float64)
        precision[:d] = 1.0
        information, score, misfit = [], [], []
        for fold in _folds(len(laws)):
            own, v = laws[fold].flatten(0, 1), laws[fold]
            block = torch.zeros(d + first, d + first, dtype=torch.float64)
            block[:d, :d] = self.by_z[fold].sum(0)
            block[:d, d:] = torch.einsum("sdp,spk->dk", self.cross[fold], v)
            block[d:, :d] = block[:d, d:].mT
            block[d:, d:] = own.mT @ (self.squares[fold] @ v).flatten(0, 1)
            information.append(block)
            by_laws = own.mT @ self.scores[fold].flatten()
            score.append(torch.cat((self.z_scores[fold].sum(0), by_laws)))
            misfit.append(self.misfits[fold].sum())
        return NormalEquations(
            tuple(kept),
            tuple(slices),
            sizes,
            torch.stack(information),
            torch.stack(score),
            torch.stack(misfit),
            precision,
            d,
            self.inflation,
        )


def _folds(num: int) -> list[Tensor]:
    """Returns contiguous parts of the segments."""
    return list(torch.arange(num).tensor_split(min(LEARNING.num_folds, num)))


@dataclass(frozen=True)
class NormalEquations:
    """Products of columns and residuals, fold by fold.

    Attributes:
        terms: The terms whose columns these are.
        slices: Columns of each term.
        sizes: Root mean square by which each column was divided, ``(k,)``.
        information: Products of the columns, the d parameters' first, ``(F, d + k, d + k)``.
        score: Products with the residuals, ``(F, d + k)``.
        misfit: Products of the residuals with themselves, ``(F,)``.
        precision: Precision of the prior of each column's coefficient, ``(d + k,)``.
        num_parameters: d.
        inflation: Number of measurements per independent one.
        num_others: Number of terms that were examined before, and are not among these.
    """

    terms: tuple[Term, ...]
    slices: tuple[slice, ...]
    sizes: Tensor
    information: Tensor
    score: Tensor
    misfit: Tensor
    precision: Tensor
    num_parameters: int
    inflation: float
    num_others: int = 0

    @property
    def all_terms(self) -> Formula:
        """The formula with all terms, whose errors are not computed."""
        information, score = self._regular(self.information.sum(0)), self.score.sum(0)
        solved = self._solved(tuple(range(len(self.terms))), information, score)
        return self._formula(solved, torch.zeros_like(self.misfit))

    def _formula(self, solved: "_Solved", errors: Tensor) -> Formula:
        """Returns the formula of some terms, fitted to the whole recording."""
        choice, index, theta = solved
        explained = self._explained(self.information.sum(0), self.score.sum(0), solved)
        own = index[self.num_parameters :] - self.num_parameters
        return Formula(
            tuple(self.terms[k] for k in choice),
            theta[self.num_parameters :] / self.sizes[own],
            errors,
            float(self.misfit.sum() - explained),
        )

    @staticmethod
    def _explained(information: Tensor, score: Tensor, solved: "_Solved") -> Tensor:
        """Returns by how much coefficients reduce the misfit with this information and score."""
        _, index, theta = solved
        own = information[index][:, index]
        return 2.0 * score[index] @ theta - theta @ own @ theta

    @property
    def penalty(self) -> float:
        """Reduction of the misfit that the best of so many spurious coefficients brings."""
        return self.inflation * 2.0 * math.log(max(2, len(self.terms) + self.num_others))

    def without_terms(self, variable: str) -> "NormalEquations":
        """Returns the equations of the terms that do not depend on a variable."""
        kept = [k for k, term in enumerate(self.terms) if not term.depends_on(variable)]
        index = self._index(kept)
        slices, first = [], 0
        for k in kept:
            width = self.slices[k].stop - self.slices[k].start
            slices.append(slice(first, first + width))
            first += width
        return replace(
            self,
            terms=tuple(self.terms[k] for k in kept),
            slices=tuple(slices),
            sizes=self.sizes[index[self.num_parameters :] - self.num_parameters],
            information=self.information[:, index][:, :, index],
            score=self.score[:, index],
            precision=self.precision[index],
        )

    def gains_alone(self) -> Tensor:
        """Returns by how much each term alone reduces the misfit; all have as many columns."""
        information, score = self._regular(self.information.sum(0)), self.score.sum(0)
        width = self.slices[0].stop - self.slices[0].start
        every = list(range(len(self.terms)))
        return self._gains(information, score, self._index(()), every, width)

    def front(self, most: int = LEARNING.most_terms) -> list[Formula]:
        """Returns the best formula of each number of terms, from none to the most.

        Args:
            most: Greatest number of terms.
        """
        whole = self.information.sum(0), self.score.sum(0)
        paths = [self._path(*whole, most)]
        for information, score in zip(self.information, self.score, strict=True):
            # A difference: the sums over the other folds would be most of the work.
            paths.append(self._path(whole[0] - information, whole[1] - score, most))
        formulas = []
        for size in range(min(len(path) for path in paths)):
            errors = [
                self.misfit[fold]
                - self._explained(self.information[fold], self.score[fold], path[size])
                for fold, path in enumerate(paths[1:])
            ]
            formulas.append(self._formula(paths[0][size], torch.stack(errors)))
        return formulas

    def _path(self, information: Tensor, score: Tensor, most: int) -> "list[_Solved]":
        """Returns for each number of terms the best choice, its columns and coefficients."""
        penalty = self.penalty
        costs = torch.tensor([term.cost for term in self.terms], dtype=torch.float64)
        widths = torch.tensor([s.stop - s.start for s in self.slices])
        information = self._regular(information)
        path = [self._solved((), information, score)]
        beam: list[tuple[int, ...]] = [()]
        for _ in range(most):
            tried: dict[tuple[int, ...], float] = {}
            for own in beam:
                fixed = self._index(own)
                # The device passes a command on once: it does not add two ways to be late.
                has_one = any(self.terms[k].is_late_command for k in own)
                for width in widths.unique():
                    new = [
                        k
                        for k in (widths == width).nonzero()[:, 0].tolist()
                        if k not in own and not (has_one and self.terms[k].is_late_command)
                    ]
                    if not new:
                        continue
                    gains = self._gains(information, score, fixed, new, int(width))
                    worth = gains - penalty * costs[new]
                    before = float(penalty * costs[list(own)].sum()) if own else 0.0
                    for n in worth.topk(min(LEARNING.beam, len(new))).indices.tolist():
                        choice = tuple(sorted((*own, new[n])))
                        tried[choice] = float(worth[n]) - before
            if not tried:
                break
            ranked = sorted(tried, key=lambda choice: -tried[choice])
            beam = ranked[: LEARNING.beam]
            path.append(self._solved(beam[0], information, score))
        return path

    def _regular(self, information: Tensor) -> Tensor:
        """Returns the information with that of the prior, and a little more on the diagonal.

        Terms can be sums of others: the hats of a spline add up to one. Without the addition,
        rounding errors would make the equations of a precise recording indefinite.
        """
        return information + (self.precision + RIDGE * information.diagonal()).diag()

    def _gains(
        self, information: Tensor, score: Tensor, fixed: Tensor, new: list[int], width: int
    ) -> Tensor:
        """Returns by how much each of several terms, with fixed columns, reduces the misfit."""
        starts = torch.tensor([self.slices[k].start for k in new]) + self.num_parameters
        index = starts[:, None] + torch.arange(width)  # (n, w)
        own = information[fixed][:, fixed]
        factor = torch.linalg.cholesky(own)
        cross = information[fixed][:, index.flatten()]
        solved = torch.cholesky_solve(cross, factor)  # (m, n w)
        known = torch.cholesky_solve(score[fixed][:, None], factor)[:, 0]
        base = score[fixed] @ known
        left = score[index] - (cross.mT @ known).view(index.shape)
        blocks = information[index[:, :, None], index[:, None, :]]
        wide = cross.view(len(fixed), *index.shape), solved.view(len(fixed), *index.shape)
        blocks = blocks - torch.einsum("mnw,mnv->nwv", *wide)
        eye = torch.eye(width, dtype=torch.float64)
        ridge = 1e-9 * blocks.diagonal(dim1=1, dim2=2).mean(-1).clamp_min(1e-12)
        found = torch.linalg.solve(blocks + ridge[:, None, None] * eye, left)
        return base + (left * found).sum(-1)

    def _solved(self, choice: tuple[int, ...], information: Tensor, score: Tensor) -> "_Solved":
        index = self._index(choice)
        theta = torch.linalg.solve(information[index][:, index], score[index])
        return choice, index, theta

    def _index(self, choice: Sequence[int]) -> Tensor:
        own = [torch.arange(self.num_parameters)]
        own += [
            torch.arange(self.slices[k].start, self.slices[k].stop) + self.num_parameters
            for k in choice
        ]
        return torch.cat(own)


def pareto_front(found: Sequence[Formula]) -> list[Formula]:
    """Returns the formulas that no simpler one predicts as well as, the simplest first."""
    front: list[Formula] = []
    for formula in sorted(found, key=lambda f: (f.cost, f.error)):
        if not front or formula.error < front[-1].error:
            front.append(formula)
    return front


def simplest(found: Sequence[Formula]) -> Formula:
    """Returns the simplest formula whose error is close to the least.

    The difference is within one standard error, from the folds, or a negligible share of what the
    best formula explains.

    Args:
        found: The formulas.
    """
    best = min(found, key=lambda formula: formula.error)

    most = max(formula.error for formula in found if not formula.terms)
    negligible = LEARNING.negligible * (most - best.error)

    def is_as_good(formula: Formula) -> bool:
        more = formula.errors - best.errors
        return float(more.sum()) <= max(negligible, float(more.std() * len(more) ** 0.5))

    # A law that acts in few folds is missing there, however different the folds are.
    laws = [f for f in found if f.terms or not best.terms]
    return min((f for f in laws if is_as_good(f)), key=lambda f: (f.cost, f.error))
