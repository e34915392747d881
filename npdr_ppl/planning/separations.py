"""Squared separations of causes and gains of information, from products of derivatives.

See :mod:`npdr_ppl.planning.judging` for the formulas.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["Shown", "apart", "information_gain"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shown:
    """What candidates would show of every pair of causes, several candidates together included.

    Attributes:
        products: (J r)ᵀ C⁻¹ (J r) by pair (a, b) and block, ``(E, blocks, d + 1, d + 1)``.
        precisions: Precision of each cause's coordinates after the recordings so far.
    """

    products: Mapping[tuple[int, int], Tensor]
    precisions: Sequence[Tensor]

    def squares(self, chosen: Sequence[int]) -> dict[tuple[int, int], Array]:
        """Returns the squared separations along several candidates together, by pair and block.

        One set of parameters must fit all of them. A candidate may be chosen several times.
        """
        return {
            (a, b): apart(found[list(chosen)].flatten(0, 1)[None], self.precisions[b])[0].numpy()
            for (a, b), found in self.products.items()
        }


def apart(products: Tensor, precision: Tensor, every: int = 1) -> Tensor:
    """Returns the squared separations after the refit, ``(E, blocks)``.

    Args:
        products: Products by block, ``(E, blocks, d + 1, d + 1)``.
        precision: Precision of the coordinates that are refitted, ``(d, d)``.
        every: Number of segments for which each one stands.
    """
    whole = every * products.sum(1)
    information, score = whole[:, :-1, :-1], whole[:, :-1, -1]
    shift = torch.linalg.solve(information + precision, score)
    # The parameters move, and the difference r becomes r − J shift.
    moved = torch.cat((-shift, torch.ones_like(shift[:, :1])), dim=-1)
    left = torch.einsum("ei,esij,ej->es", moved, products, moved)
    # Moved parameters fit the recordings so far less well, nearly evenly.
    before = torch.einsum("ei,ij,ej->e", shift, precision, shift)
    left = left + before[:, None] / (every * left.shape[1])
    return left.clamp_min(0.0).nan_to_num(-math.inf)


def information_gain(before: Tensor, after: Tensor) -> Tensor:
    """Returns ½ log det(P⁻¹ P'), in nats, ``(E,)``, of precisions P and P', ``(E, d, d)``."""
    return 0.5 * (torch.linalg.slogdet(after).logabsdet - torch.linalg.slogdet(before).logabsdet)
