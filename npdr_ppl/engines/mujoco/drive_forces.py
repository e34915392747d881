"""Forces of actuators at joints without a call of the engine."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.mujoco.batches import state_view
from npdr_ppl.engines.mujoco.ports import ForcePort
from npdr_ppl.language.effect_context import Joint

__all__ = ["DriveForces", "has_direct_drives"]

Array = NDArray[np.float64]


def has_direct_drives(model: Any) -> bool:
    """Returns whether the force of every actuator follows from command, position and velocity.

    Such actuators act on hinges and slides directly, have no state and at most affine laws. Motors
    and servos are of this kind. The engine must not limit commands, as in a model of a batch.

    Args:
        model: A ``mujoco.MjModel``.
    """
    mujoco: Any = importlib.import_module("mujoco")
    hinges_and_slides = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    off = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    unlimited = int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    return bool(
        (model.opt.disableflags & unlimited or not model.actuator_ctrllimited.any())
        and np.all(model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
        and np.isin(model.jnt_type[model.actuator_trnid[:, 0]], hinges_and_slides).all()
        and np.all(model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE))
        and np.all(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
        and np.isin(
            model.actuator_biastype,
            (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)),
        ).all()
        and np.all(model.actuator_delay == 0.0)
        and np.all(model.actuator_plugin < 0)
        and not model.jnt_actgravcomp.any()
        and not model.opt.disableactuator
        and not model.opt.disableflags & off
    )


class DriveForces:
    """Forces of actuators at joints in the present state.

    The engine computes them only together with all accelerations, which takes as long as a step.

    Args:
        batch: A ``mujoco.batch.Batch`` of N simulations; see :func:`has_direct_drives`.
        ports: The joints.
    """

    def __init__(self, batch: Any, ports: Sequence[ForcePort]) -> None:
        self._batch, model = batch, batch.model
        mujoco: Any = importlib.import_module("mujoco")
        moved = model.actuator_trnid[:, 0]
        self._controls = state_view(batch, "ctrl")
        self._positions, self._velocities = state_view(batch, "qpos"), state_view(batch, "qvel")
        self._places = model.jnt_qposadr[moved], model.jnt_dofadr[moved]
        self._has_bias = model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_NONE)
        self._force_limited = np.asarray(model.actuator_forcelimited, dtype=bool)
        self._limited_joints = [
            (i, port.joint) for i, port in enumerate(ports) if model.jnt_actfrclimited[port.joint]
        ]
        self._actuators = [np.flatnonzero(moved == port.joint) for port in ports]

    def read(self, positions: Components, velocities: Components) -> tuple[Joint, ...]:
        """Returns the joints; accelerations and inertias are NaN.

        Args:
            positions: Position of each, ``(N,)``.
            velocities: Velocity of each, ``(N,)``.
        """
        gears = self._field("actuator_gear")[..., 0]
        gains, bias = self._field("actuator_gainprm"), self._field("actuator_biasprm")
        at, rates = self._places
        lengths, speeds = gears * self._positions[:, at], gears * self._velocities[:, rates]
        own = bias[..., 0] + bias[..., 1] * lengths + bias[..., 2] * speeds
        forces = gains[..., 0] * self._controls + np.where(self._has_bias, own, 0.0)
        if self._force_limited.any():
            lower, upper = np.moveaxis(self._field("actuator_forcerange"), -1, 0)
            limited = np.clip(forces, lower, upper)
            forces = np.where(self._force_limited, limited, forces)
        forces = gears * forces
        drives = [forces[:, actuators].sum(axis=1) for actuators in self._actuators]
        for place, joint in self._limited_joints:
            lower, upper = np.moveaxis(self._field("jnt_actfrcrange")[..., joint, :], -1, 0)
            drives[place] = np.clip(drives[place], lower, upper)
        unknown = torch.full((len(forces),), torch.nan, dtype=torch.float64)
        return tuple(
            Joint(q, v, unknown, unknown, torch.from_numpy(drive))
            for q, v, drive in zip(positions, velocities, drives, strict=True)
        )

    def _field(self, name: str) -> Array:
        """Returns a field of the model, with a first dimension of N where simulations differ."""
        own = self._batch.expanded(name)
        return np.asarray(getattr(self._batch.model, name) if own is None else own)
