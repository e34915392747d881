"""How fast joints and servos damp a mechanism's motion."""

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    root = np.sqrt(np.maximum(drive_damping(model), 0.0))
    return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(inertia) * root).max())


def drive_damping(model: Any) -> NDArray[np.float64]:
    """Returns the damping of each degree of freedom, of joints and the servos on them, ``(nv,)``.

    Args:
        model: A ``mujoco.MjModel``.
    """
    mujoco: Any = importlib.import_module("mujoco")
    damping = model.dof_damping.copy()
    for actuator in range(model.nu):
        is_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        if is_joint and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
            dof = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
            gear = model.actuator_gear[actuator, 0]
            damping[dof] += max(0.0, -gear * gear * model.actuator_biasprm[actuator, 2])
    return damping
