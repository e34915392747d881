"""How fast joints and servos damp a mechanism's motion."""

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.mujoco.parameters import Assignments, present

__all__ = ["drive_damping", "fastest_damping"]


def fastest_damping(model: Any, positions: NDArray[np.float64]) -> float:
    """Returns the greatest rate at which damping reduces velocities, 1/s.

    It is the greatest eigenvalue of M⁻¹ D, with the inertia M and the damping D of the joints and
    of the actuators that act on one joint.

    Args:
        model: A ``mujoco.MjModel``.
        positions: Positions ``qpos`` at which M is computed.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if not model.nv:
        return 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = positions
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    damping = [float(drive_damping(model, dof, {})) for dof in range(model.nv)]
    root = np.sqrt(np.maximum(damping, 0.0))
    return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(inertia) * root).max())


def drive_damping(model: Any, dof: int, assignments: Assignments) -> Tensor:
    """Returns the damping of a degree of freedom: that of its joint and of the servos on it.

    Args:
        model: A ``mujoco.MjModel``.
        dof: Number of the degree of freedom.
        assignments: What is written into the model.
    """
    mujoco: Any = importlib.import_module("mujoco")
    total = present(model, "dof_damping", dof, assignments)
    width = model.actuator_biasprm.shape[1]
    for actuator in range(model.nu):
        is_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        is_affine = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        if is_joint and is_affine and model.jnt_dofadr[model.actuator_trnid[actuator, 0]] == dof:
            slope = present(model, "actuator_biasprm", actuator * width + 2, assignments)
            total = total + (-(model.actuator_gear[actuator, 0] ** 2) * slope).clamp_min(0.0)
    return total
