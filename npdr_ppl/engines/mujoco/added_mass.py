"""A point mass that is fixed to a body: the numbers of a model that it changes."""

from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from npdr_ppl.engines.mujoco.parameters import Assignments, present

__all__ = ["with_point_mass"]


def with_point_mass(
    model: Any,
    body: int,
    total: Tensor,
    place: tuple[Tensor, Tensor, Tensor],
    assignments: Assignments,
) -> Assignments:
    """Returns the mass, centre and inertia of a body together with a point mass.

    The centre moves by d Δm/(m + Δm), and the inertia about it grows by μ (|d|² 1 − d dᵀ) with the
    reduced mass μ = m Δm/(m + Δm). Without an added mass, all numbers stay exactly as they are.

    Args:
        model: A ``mujoco.MjModel``.
        body: Number of the body, of mass m.
        total: The mass of both, m + Δm, in kg, a number or ``(N,)``.
        place: Its place d from the body's centre of mass along the body's axes, in m, likewise.
        assignments: Values to write into the model without it.
    """

    def numbers(array: str, count: int) -> Tensor:
        """Returns a row of an array, ``(..., count)``."""
        row = [present(model, array, count * body + i, assignments) for i in range(count)]
        return torch.stack(torch.broadcast_tensors(*row), dim=-1)

    mass = present(model, "body_mass", body, assignments)
    added = total - mass
    # A body may have no mass of its own; its share of nothing is nothing.
    share = torch.where(added == 0.0, 0.0, added / total)
    distance = torch.stack(torch.broadcast_tensors(*place), dim=-1)
    centre, inertia = numbers("body_ipos", 3), numbers("body_inertia", 3)
    turn = numbers("body_iquat", 4)
    moved = centre + share[..., None] * distance
    axes = _matrices(turn)
    along = (axes.mT @ distance[..., None])[..., 0]
    square = (along * along).sum(-1)[..., None, None] * torch.eye(3, dtype=torch.float64)
    reduced = (mass * share)[..., None, None]
    more = reduced * (square - along[..., None] * along[..., None, :])
    whole = torch.diag_embed(inertia) + more
    # One simulation with impossible numbers must not end the others; it is lost by its mass.
    is_possible = whole.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    whole = torch.where(is_possible, whole, torch.eye(3, dtype=torch.float64))
    values, vectors = torch.linalg.eigh(whole)
    vectors = vectors * torch.linalg.det(vectors).sign()[..., None, None]
    is_same = (more == 0.0).all(-1).all(-1)[..., None]
    inertia = torch.where(is_same, inertia, values)
    turn = torch.where(is_same, turn, _quaternions(axes @ vectors))
    result = dict(assignments)
    result["body_mass", body] = total
    rows = (("body_ipos", moved), ("body_inertia", inertia), ("body_iquat", turn))
    for array, row in rows:
        count = row.shape[-1]
        result |= {(array, count * body + i): row[..., i].contiguous() for i in range(count)}
    return result


def _matrices(quaternions: Tensor) -> Tensor:
    """Returns the rotation matrices, ``(..., 3, 3)``, of MuJoCo's quaternions, ``(..., 4)``."""
    w_last = quaternions.numpy()[..., [1, 2, 3, 0]]
    return torch.from_numpy(Rotation.from_quat(w_last).as_matrix())


def _quaternions(matrices: Tensor) -> Tensor:
    """Returns the quaternions, ``(..., 4)``, of rotation matrices."""
    return torch.from_numpy(Rotation.from_matrix(matrices.numpy()).as_quat()[..., [3, 0, 1, 2]])
