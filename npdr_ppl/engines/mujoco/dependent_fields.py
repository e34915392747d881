"""Finds fields of a MuJoCo model whose effect on the motion other fields have as well.

A recording of positions determines the accelerations a(q, v, u) at the states (q, v) and commands
u that occur. Let J be the derivatives of many accelerations with respect to the logarithms of the
fields. A field whose column is a combination of other columns has no effect of its own. Examples
are the damping of a joint beside the kv of its servo, the inertia of a vertical first link beside
the armature of its joint, and one of all masses, gains and dampings, of which positions determine
only ratios.
"""

import copy
import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.fields import Field
from npdr_ppl.engines.mujoco.ports import actuator_moments

__all__ = ["dependent_fields"]

Array = NDArray[np.float64]

NUM_STATES = 40
"""Random states and commands. Each gives an acceleration per degree of freedom, and a robot has
about five fields per degree of freedom."""

STEP = 1e-4
"""Relative change of a field for central differences. Their error is about 1e-8 times the size of
a derivative."""

OWN_SHARE = 1e-5
"""A field is dependent if less than this share of its column is not a combination of others. Exact
dependence leaves 1e-8 of it. A share of 1e-3 may matter in a long recording; the prior holds such
fields where it does not."""

SOLVER_TOLERANCE = 1e-14
"""Tolerance of the constraint solver. Differences of accelerations need it smaller than usual."""

SOLVER_ITERATIONS = 200
"""Most iterations of the constraint solver; its Newton method needs about ten."""

USUAL_ACCELERATION = 10.0
"""Acceleration in rad/s² or m/s² that sets the size of random forces of actuators: that of 0.5 rad
at 0.7 Hz. With much larger forces, friction and gravity would seem to have no effect."""

NO_EFFECT = 1e-9
"""A field has no effect at all if its column is smaller than this share of the largest one."""

WORTH_NAMING = 0.01
"""Smallest contribution of another field, as a share of the column, for it to be named."""


def dependent_fields(model: Any, fields: Sequence[Field]) -> dict[str, tuple[str, ...]]:
    """Returns the fields that have no effect of their own on the motion.

    Limits of forces and joints, and contacts, are left out.

    Args:
        model: A ``mujoco.MjModel``, which is not changed.
        fields: Fields with positive values; where some depend on each other, the last ones are
            dependent.

    Returns:
        The dependent fields, each with the other fields that have the same effect together, the
        largest contribution first; none if the field has no effect at all.
    """
    columns = _relative_derivatives(model, fields)
    sizes = np.linalg.norm(columns, axis=0)
    kept: list[int] = []
    found: dict[str, tuple[str, ...]] = {}
    for index, field in enumerate(fields):
        if sizes[index] <= NO_EFFECT * sizes.max():
            found[field.text] = ()
            continue
        own, others = columns[:, index], columns[:, kept]
        shares = np.linalg.lstsq(others, own, rcond=None)[0]
        if np.linalg.norm(own - others @ shares) > OWN_SHARE * sizes[index]:
            kept.append(index)
            continue
        parts = np.abs(shares) * sizes[kept] / sizes[index]
        order = [i for i in np.argsort(-parts, kind="stable") if parts[i] > WORTH_NAMING]
        found[field.text] = tuple(fields[kept[i]].text for i in order)
    return found


def _relative_derivatives(model: Any, fields: Sequence[Field]) -> Array:
    """Returns the derivatives of accelerations by the fields' logarithms, ``(N, fields)``.

    Accelerations are divided by the root mean square of their degree of freedom.
    """
    mujoco: Any = importlib.import_module("mujoco")
    free = copy.copy(model)
    free.actuator_forcelimited[:] = 0
    free.jnt_actfrclimited[:] = 0
    free.opt.tolerance, free.opt.iterations = SOLVER_TOLERANCE, SOLVER_ITERATIONS
    flags = mujoco.mjtDisableBit
    free.opt.disableflags |= int(flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT)
    states = _random_states(free)

    def accelerations(field: Field | None, factor: float) -> Array:
        changed = copy.copy(free)
        for entry in field.entries if field else ():
            getattr(changed, entry.array).reshape(-1)[entry.place] = factor * entry.nominal
        data = mujoco.MjData(changed)
        mujoco.mj_setConst(changed, data)
        rows = []
        for positions, velocities, commands in states:
            data.qpos[:], data.qvel[:], data.ctrl[:] = positions, velocities, commands
            mujoco.mj_forward(changed, data)
            rows.append(data.qacc.copy())
        return np.stack(rows)

    usual = np.sqrt(np.mean(accelerations(None, 1.0) ** 2, axis=0))
    columns = [
        (accelerations(field, 1.0 + STEP) - accelerations(field, 1.0 - STEP)) / (2.0 * STEP)
        for field in fields
    ]
    scaled = [
        (column / np.maximum(usual, max(1e-9 * usual.max(), 1e-300))).reshape(-1)
        for column in columns
    ]
    return np.stack(scaled, axis=-1)


def _random_states(model: Any) -> list[tuple[Array, Array, Array]]:
    """Returns random positions, velocities and commands.

    Commands are such that the forces of actuators have a usual size, also those of stiff servos.
    """
    mujoco: Any = importlib.import_module("mujoco")
    random = np.random.default_rng(0)
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    is_fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    states = []
    for _ in range(NUM_STATES):
        data.qpos[:], data.qvel[:] = model.qpos0, random.standard_normal(model.nv)
        mujoco.mj_integratePos(model, data.qpos, random.standard_normal(model.nv), 1.0)
        data.ctrl[:] = 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        usual = np.abs(data.qfrc_bias) + USUAL_ACCELERATION * np.diag(inertia)
        moments = np.abs(actuator_moments(model, data))
        sizes = moments @ usual / np.maximum((moments**2).sum(axis=1), 1e-12)
        wanted = sizes * random.standard_normal(model.nu)
        gain = np.where(is_fixed, model.actuator_gainprm[:, 0], 0.0)
        # Without a command, the force of such an actuator is its bias.
        command = (wanted - data.actuator_force) / np.where(gain == 0.0, 1.0, gain)
        command = np.where(gain == 0.0, random.standard_normal(model.nu), command)
        states.append((data.qpos.copy(), data.qvel.copy(), command))
    return states
