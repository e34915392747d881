"""Linear systems of many segments at once, of which some may not be solvable."""

import torch
from torch import Tensor

__all__ = ["is_invertible", "solve_or_zero"]


def solve_or_zero(matrix: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Solves linear systems; where that fails the solution is zero.

    A simulation that diverges has derivatives so large that a matrix of their squares is singular
    to working precision. Which machine meets an exact zero there depends on its rounding.

    Args:
        matrix: The matrices, ``(…, m, m)``.
        sides: The right-hand sides, ``(…, m, p)``.

    Returns:
        The solutions ``(…, m, p)``, and which systems were solved, a mask ``(…)``.
    """
    solution, info = torch.linalg.solve_ex(matrix, sides)
    is_solved = (info == 0) & solution.isfinite().all(-1).all(-1)
    return torch.where(is_solved[..., None, None], solution, 0.0), is_solved


def is_invertible(matrix: Tensor) -> Tensor:
    """Returns which matrices have an inverse to working precision, a mask ``(…)``.

    Of those that have not, rounding alone decides what a solver returns. An empty matrix has one.

    Args:
        matrix: Symmetric positive semidefinite matrices of finite entries, ``(…, m, m)``.
    """
    m = matrix.shape[-1]
    if m == 0:
        return torch.ones(matrix.shape[:-2], dtype=torch.bool)
    values = torch.linalg.eigvalsh(matrix)
    return values[..., 0] > m * torch.finfo(matrix.dtype).eps * values[..., -1]
