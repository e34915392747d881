"""Inverse dynamics of an MJCF file as a linear form in the domain parameters bound to it.

The file's inverse dynamics are linear in its inertial and friction parameters, Y π = τ; see
:mod:`npdr_ppl.engines.mujoco.base_parameters`. Where π is affine in the domain parameters θ,

    π = π₀ + D (θ − θ₀)    so that    (Y D) θ = τ − Y (π₀ − D θ₀),

the domain parameters are base parameters themselves. That holds for masses, inertias, dampings,
dry frictions and armatures, and for factors on them. It does not hold for lengths, nor for gravity
and actuators, which are not part of Y.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.mujoco.base_parameters import MujocoInverseDynamics, actuator_forces
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.linear_dynamics import BaseParameter, InverseDynamics, Motion

if TYPE_CHECKING:
    from npdr_ppl.engines.mujoco.parameters import Assignments

__all__ = ["BoundInverseDynamics", "bound_inverse_dynamics"]

Array = NDArray[np.float64]

_LINEAR_ARRAYS = {
    "body_mass",
    "body_inertia",
    "dof_damping",
    "dof_frictionloss",
    "dof_armature",
    # The first moment is linear in it. Inertias about the origin are not, but the check below
    # rejects bindings for which this matters.
    "body_ipos",
}

_SOFTNESS = {"dof_solimp", "dof_solref"}
"""How far dry friction yields, which the equations of motion do not contain: in them it holds."""


def bound_inverse_dynamics(simulator: MujocoMechanism) -> InverseDynamics | None:
    """Returns the linear form, or ``None`` if a simulator does not have it.

    All joints must be hinges or slides and states of the simulator. There must be no equality
    constraints and no actuators with states. The file's inertial and friction parameters must be
    affine in the domain parameters. Motions should be free of contacts and away from joint limits.
    """
    model, bindings = simulator.model, simulator.bindings
    is_simple = model.nv > 0 and model.nq == model.nv and not model.neq and not model.na
    is_whole = [(c.is_velocity, c.address) for c in simulator.components] == [
        (is_velocity, i) for is_velocity in (False, True) for i in range(model.nv)
    ]
    arrays = bindings.arrays
    if not (is_simple and is_whole and arrays & _LINEAR_ARRAYS):
        return None
    if not arrays <= _LINEAR_ARRAYS | _SOFTNESS:
        return None
    if not np.any(model.body_mass):
        return None
    held = bindings.names_setting(_SOFTNESS)
    if held & bindings.names_setting(_LINEAR_ARRAYS):
        return None
    determined = tuple(p for p in simulator.parameters if p.name not in held)
    nominal = np.array([parameter.nominal for parameter in determined])
    rest = {p.name: torch.tensor(p.nominal, dtype=torch.float64) for p in simulator.parameters}

    def inertial(values: Array) -> Array:
        names = [parameter.name for parameter in determined]
        given = rest | dict(zip(names, torch.from_numpy(values).unbind(), strict=True))
        changed = _written(model, bindings.assignments(given, given))
        return MujocoInverseDynamics(changed).nominal()

    steps = np.where(nominal == 0.0, 1.0, np.abs(nominal))
    start = inertial(nominal)
    columns = [inertial(nominal + row) - start for row in np.diag(steps)]
    slopes = np.stack(columns, axis=-1) / steps
    together = inertial(nominal + 0.5 * steps)
    error = np.abs(together - start - slopes @ (0.5 * steps))
    # Relative errors are 1e-16 for affine functions (rounding) and 1/4 for products of parameters.
    if np.any(error > 1e-9 * (np.abs(together) + np.abs(start) + np.abs(slopes) @ steps)):
        return None
    return BoundInverseDynamics(simulator, determined, start - slopes @ nominal, slopes)


class BoundInverseDynamics(InverseDynamics):
    """The equations (Y D) θ = τ − Y π_c with π = π_c + D θ.

    Args:
        simulator: The simulator.
        determined: The parameters θ, all that the equations contain, ``k`` of them.
        constant: π_c, ``(P,)``.
        slopes: D, ``(P, k)``.
    """

    def __init__(
        self,
        simulator: MujocoMechanism,
        determined: Sequence[Parameter],
        constant: Array,
        slopes: Array,
    ) -> None:
        self._model = simulator.model
        self._constant, self._slopes = constant, slopes
        self.base = tuple(BaseParameter(p.name, p.unit, p.description) for p in determined)
        self.determined = tuple(parameter.name for parameter in determined)
        masses = simulator.bindings.names_setting({"body_mass", "body_inertia"})
        brakes = {"dof_damping", "dof_frictionloss", "dof_armature"}
        self.positive = tuple(name for name in self.determined if name in masses)
        self.non_negative = tuple(
            name for name in self.determined if name in simulator.bindings.names_setting(brakes)
        )

    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y D, ``(N, joints, k)``."""
        return torch.from_numpy(self._rows(motion) @ self._slopes)

    def targets(self, motion: Motion) -> Tensor:
        """Returns τ − Y π_c, ``(N, joints)``, in N m or N."""
        positions, velocities = _table(motion.positions), _table(motion.velocities)
        controls = _table(motion.actions) if motion.actions else np.zeros((len(positions), 0))
        applied = actuator_forces(self._model, positions, velocities, controls)
        dynamics = MujocoInverseDynamics(self._model)
        known = dynamics.targets(positions, velocities, applied)
        return torch.from_numpy(known - self._rows(motion) @ self._constant)

    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the parameters side by side, ``B + (k,)``."""
        values = [parameters[name] for name in self.determined]
        return torch.stack(torch.broadcast_tensors(*values), dim=-1)

    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the parameters by name."""
        return dict(zip(self.determined, base.unbind(-1), strict=True))

    def _rows(self, motion: Motion) -> Array:
        """Returns Y, ``(N, joints, P)``."""
        return MujocoInverseDynamics(self._model).regressors(
            _table(motion.positions), _table(motion.velocities), _table(motion.accelerations)
        )


def _table(columns: tuple[Tensor, ...]) -> Array:
    return torch.stack(columns, dim=-1).double().numpy()


def _written(model: Any, assignments: "Assignments") -> Any:
    """Returns a copy of a model with changed values in its arrays."""
    changed = copy.copy(model)
    for (array, place), value in assignments.items():
        getattr(changed, array).reshape(-1)[place] = float(value)
    return changed
