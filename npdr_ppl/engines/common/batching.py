"""One flat axis for a whole batch of simulations."""

from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

__all__ = ["flatten"]


def flatten(tree: Any, shape: torch.Size, *, expand: bool = False) -> Any:
    """Returns the tree with every tensor expanded to ``shape`` and flat.

    One flat axis vectorises well for every shape of the batch.

    Args:
        tree: Nested tuples and dictionaries of tensors that broadcast to ``shape``.
        shape: The batch's shape.
        expand: Whether to expand single numbers too, so that a compiled kernel does not depend on
            which parameters vary.
    """

    def flat(leaf: Tensor) -> Tensor:
        if leaf.numel() == 1 and not expand:
            return leaf.reshape(())
        # A single number expands to a view with stride 0, which would need a separate kernel.
        return leaf.expand(shape).reshape(-1).contiguous()

    return pytree.tree_map_only(Tensor, flat, tree)
