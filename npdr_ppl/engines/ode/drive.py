"""The inertia of a joint with respect to a force on it, and the force that actions exert."""

from typing import Any

import torch

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.ode.mechanical_system import MechanicalSystem

__all__ = ["drive_forces", "inverse_inertia"]


def inverse_inertia(
    simulator: MechanicalSystem,
    positions: Components,
    velocities: Components,
    actions: Components,
    forces: tuple[Any, ...],
    constants: Any,
    accelerations: Components,
) -> tuple[Components, ...]:
    """Returns the rows of W = ∂a/∂f, as declared, or else computed with unit forces.

    Args:
        simulator: The system.
        positions: Generalised positions q.
        velocities: Generalised velocities.
        actions: Actions after all effects.
        forces: Generalised forces of effects.
        constants: The system's constants.
        accelerations: Accelerations in this state, under these actions and forces.
    """
    declared = simulator.inverse_inertia(positions, velocities, constants)
    if declared:
        return declared
    columns = []
    for joint in range(len(positions)):
        pushed = tuple(f + 1.0 if i == joint else f for i, f in enumerate(forces))
        moved = simulator.accelerations(positions, velocities, actions, pushed, constants)
        columns.append(tuple(b - a for a, b in zip(accelerations, moved, strict=True)))
    return tuple(zip(*columns, strict=True))


def drive_forces(
    simulator: MechanicalSystem,
    positions: Components,
    velocities: Components,
    actions: Components,
    forces: tuple[Any, ...],
    constants: Any,
    accelerations: Components,
    inertia: tuple[Components, ...],
) -> Components:
    """Returns the generalised forces τ of the actions: W τ = a(u) − a(0).

    Args:
        simulator: The system.
        positions: Generalised positions q.
        velocities: Generalised velocities.
        actions: Actions after all effects.
        forces: Generalised forces of effects.
        constants: The system's constants.
        accelerations: Accelerations in this state, under these actions and forces.
        inertia: Rows of W.
    """
    still = tuple(torch.zeros_like(action) for action in actions)
    without = simulator.accelerations(positions, velocities, still, forces, constants)
    gained = tuple(a - b for a, b in zip(accelerations, without, strict=True))
    if len(gained) == 1:
        return (gained[0] / inertia[0][0],)
    if len(gained) == 2:
        (a, b), (c, d) = inertia
        determinant = a * d - b * c
        first = (d * gained[0] - b * gained[1]) / determinant
        return first, (a * gained[1] - c * gained[0]) / determinant
    size = gained[0].shape
    rows = [torch.stack([entry.expand(size) for entry in row], dim=-1) for row in inertia]
    matrix = torch.stack(rows, dim=-2)
    return torch.linalg.solve(matrix, torch.stack(gained, dim=-1)).unbind(-1)
