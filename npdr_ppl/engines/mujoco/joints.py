"""Joint quantities of a batch that force effects need before a step."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.mujoco.ports import ForcePort
from npdr_ppl.language.effect_context import Joint

__all__ = ["JointStates"]

Array = NDArray[np.float64]


class JointStates:
    """Accelerations, inertias and drive forces that the engine computed last.

    Accelerations include the forces of contacts, limits and the file's own dry friction. An
    inverse inertia is a diagonal entry of M⁻¹, without constraints. A drive force is the total
    force of the actuators at the joint, including servo feedback and back-EMF.

    Args:
        batch: A ``mujoco.batch.Batch`` of N simulations.
        ports: The joints.
    """

    def __init__(self, batch: Any, ports: Sequence[ForcePort]) -> None:
        model = batch.model
        self._acceleration = batch.bind("qacc")
        self._drive = batch.bind("qfrc_actuator")
        # M is stored as the non-zero entries of its lower triangle, row by row.
        self._inertia = batch.bind("M")
        self._size = int(model.nv)
        counts = np.asarray(model.M_rownnz)
        first = np.repeat(np.asarray(model.M_rowadr), counts)
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        self._entries = first + within
        self._rows = np.repeat(np.arange(self._size), counts)
        self._columns = np.asarray(model.M_colind)[self._entries]
        self._velocities = [port.velocity for port in ports]

    def read(self, positions: Components, velocities: Components) -> tuple[Joint, ...]:
        """Returns the joints.

        Args:
            positions: Position of each, ``(N,)``.
            velocities: Velocity of each, ``(N,)``.
        """
        inertia = np.zeros((self._size, self._size, len(self._inertia)))
        values = self._inertia[:, self._entries].T
        inertia[self._rows, self._columns] = values
        inertia[self._columns, self._rows] = values
        inverse = torch.from_numpy(_inverse(inertia))
        acceleration = torch.from_numpy(self._acceleration.copy())
        drive = torch.from_numpy(self._drive.copy())
        return tuple(
            Joint(q, v, acceleration[:, i], inverse[i, i], drive[:, i])
            for q, v, i in zip(positions, velocities, self._velocities, strict=True)
        )


def _inverse(matrices: Array) -> Array:
    """Returns the inverses of positive definite matrices, ``(n, n, N)``; overwrites its argument.

    Each row is swept once for all matrices (Goodnight 1979, A tutorial on the SWEEP operator),
    which takes a fraction of the time of one LAPACK call per small matrix. The matrix of a lost
    simulation may be singular. Its inverse is then infinite, NaN or huge, and the others do not
    change.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(len(matrices)):
            pivot, column = matrices[k, k].copy(), matrices[:, k].copy()
            row = matrices[k] / pivot
            matrices -= column[:, None] * row
            matrices[:, k] = -column / pivot
            matrices[k] = row
            matrices[k, k] = 1.0 / pivot
    return matrices
