"""Linear systems of many segments at once, some of which may be singular."""

import torch
from torch import Tensor

__all__ = ["is_invertible", "solve_or_zero"]


def solve_or_zero(matrix: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Solves linear systems; where that fails the solution is zero.

    A simulation that diverges has derivatives so large that a matrix of their squares is singular
    to working precision. Whether a solver meets an exact zero there depends on the machine's
    rounding.

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

    For the others a solver's result depends on rounding alone. An empty matrix has an inverse.

    Args:
        matrix: Symmetric positive semidefinite matrices of finite entries, ``(…, m, m)``.
    """
    m = matrix.shape[-1]
    if m == 0:
        return torch.ones(matrix.shape[:-2], dtype=torch.bool)
    values = torch.linalg.eigvalsh(matrix)
    return values[..., 0] > m * torch.finfo(matrix.dtype).eps * values[..., -1]
