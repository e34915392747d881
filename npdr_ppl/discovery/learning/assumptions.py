"""What a user knows about a missing law before it is learned."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.regression import Formula
from npdr_ppl.discovery.learning.term import Term

__all__ = ["Assumptions", "Symmetry"]

Symmetry = Literal["odd", "even"]
"""``odd``: mirrored motion and commands mirror the law, f(−q, −v, −τ) = −f(q, v, τ). ``even``:
they do not change it."""

TOLERANCE = 1e-9
"""Largest difference from a symmetry or from passivity over the largest value: rounding."""


@dataclass(frozen=True)
class Assumptions:
    """What a user knows about a missing law.

    Attributes:
        symmetry: Its symmetry; ``None`` if it may have none.
        is_passive: Whether it takes energy from its joint at every moment, as friction does. Laws
            at commands and sensors are then left out.
    """

    symmetry: Symmetry | None = None
    is_passive: bool = False

    def applied_to(self, terms: Sequence[Term], motion: PortMotion) -> list[Term]:
        """Returns the terms that agree with the assumptions, without columns that do not.

        Args:
            terms: The terms.
            motion: The motion at the port.
        """
        if self.is_passive and motion.port.kind != "force":
            return []
        allowed = (self._part_of(term, motion) for term in terms)
        return [term for term in allowed if term is not None]

    def agrees(self, formula: Formula, motion: PortMotion) -> bool:
        """Returns whether a formula with its coefficients agrees with the assumptions."""
        if not self.is_passive or not formula.terms:
            return True
        columns = torch.cat([term.values(motion) for term in formula.terms], dim=-1)
        power = (columns @ formula.coefficients) * motion.values["v"]
        return bool((power <= TOLERANCE * power.abs().max()).all())

    def _part_of(self, term: Term, motion: PortMotion) -> Term | None:
        """Returns a term with the columns that agree; ``None`` if none does."""
        if self.symmetry is None and not self.is_passive:
            return term
        values = term.values(motion)
        kept = torch.ones(values.shape[-1], dtype=torch.bool)
        if self.symmetry is not None:
            sign = -1.0 if self.symmetry == "odd" else 1.0
            kept &= _is_zero(term.values(_mirrored(motion)) - sign * values, values)
        if self.is_passive:
            power = values * motion.values["v"][..., None]
            kept &= _is_zero(power.clamp_min(0.0), power) | _is_zero(power.clamp_max(0.0), power)
        if bool(kept.all()):
            return term
        index = kept.nonzero()[:, 0].tolist()
        if not index:
            return None
        formulas = tuple(term.formulas[k] for k in index)
        values_of_shapes = "".join(f" {shape.value:.6g}" for shape in term.shapes)
        return replace(
            term,
            key=" + ".join(formulas) + values_of_shapes,
            columns=tuple(term.columns[k] for k in index),
            formulas=formulas,
            units=tuple(term.units[k] for k in index),
            cost=term.cost - (len(term.columns) - len(index)),
        )


def _mirrored(motion: PortMotion) -> PortMotion:
    values = {name: x if name == "t" else -x for name, x in motion.values.items()}
    return replace(motion, values=values)


def _is_zero(difference: Tensor, values: Tensor) -> Tensor:
    """Returns for each column whether a difference is zero beside the values, ``(k,)``."""
    return difference.abs().amax((0, 1)) <= TOLERANCE * values.abs().amax((0, 1))
