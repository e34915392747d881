"""Batches of MuJoCo simulations whose parameters differ."""

import copy
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.errors import ModelError

__all__ = [
    "can_move_centre",
    "has_constraints",
    "make_batch",
    "prepared_copy",
    "quiet",
    "state_view",
]

# MuJoCo's friction is soft: it reduces a joint's speed over the time constant of ``solref`` and
# lets a stuck joint creep. These values are the hardest allowed: the greatest impedance, and a
# time constant of two steps, with which the joint stops after one step.
_CRISP_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_CRISP_STEPS = 2.0

# Numbers per body of the fields that place its inertial frame.
_FRAMES = {"body_ipos": 3, "body_iquat": 4}

# Up to this number of simulations, setting values in each one is faster than changing a shared
# model.
_FEW = 64


def make_batch(
    model: Any, assignments: Assignments, num_simulations: int, num_threads: int
) -> Any:
    """Returns a ``mujoco.batch.Batch`` whose models have the assigned values.

    Args:
        model: A ``mujoco.MjModel``, which is not changed.
        assignments: Values, numbers or ``(N,)``.
        num_simulations: N.
        num_threads: Threads to run on.
    """
    mujoco: Any = importlib.import_module("mujoco")
    module: Any = importlib.import_module("mujoco.batch")
    # Constants such as inverse inertias depend on some fields. Computing them costs microseconds
    # per simulation, so this is done only if such a field was changed.
    followed = set(getattr(mujoco.MjModel, "_setconst_inputs", ())) or {a for a, _ in assignments}
    model = _with_free_frames(model, {p // _FRAMES[a] for a, p in assignments if a in _FRAMES})
    shared = {}
    if num_simulations > _FEW:
        shared = {key: float(value) for key, value in assignments.items() if value.numel() == 1}
    if shared:
        model = copy.copy(model)
        for (array, place), value in shared.items():
            _write_shared(model, array, place, value)
        if any(array in followed for array, _ in shared):
            mujoco.mj_setConst(model, mujoco.MjData(model))
    batch = module.Batch(model, num_simulations, num_threads)
    own = {key: value for key, value in assignments.items() if key not in shared}
    for (array, place), value in own.items():
        batch.expand(array).reshape(num_simulations, -1)[:, place] = value.numpy()
    if any(array in followed for array, _ in own):
        # If these constants do not exist for some values, that simulation is lost; its warnings
        # record this.
        try:
            batch.set_const()
        except module.SimulationError:
            pass
    return batch


def _with_free_frames(model: Any, bodies: set[int]) -> Any:
    """Returns a model in which the inertial frames of some bodies may move.

    Where such a frame is that of its body, MuJoCo compiles shortcuts, with which it ignores a
    frame that moves later.

    Args:
        model: A ``mujoco.MjModel``, which is not changed.
        bodies: Indices of the bodies.

    Raises:
        ModelError: A shortcut cannot be taken back.
    """
    fixed = [b for b in sorted(bodies) if model.body_sameframe[b] or model.body_simple[b]]
    if not fixed:
        return model
    changed = copy.copy(model)
    for body in fixed:
        if not can_move_centre(model, body):
            raise ModelError(
                f"The centre of mass of body {model.body(body).name!r} cannot be changed, because "
                "it is at the joints' origin in the file; move it there by 1e-6 m."
            )
        changed.body_sameframe[body] = 0
        if model.body_simple[body]:
            changed.body_simple[body] = 0
            changed.dof_simplenum[: model.body_dofadr[body] + model.body_dofnum[body]] = 0
    return changed


def can_move_centre(model: Any, body: int) -> bool:
    """Returns whether simulations can move the centre of mass of a body.

    Args:
        model: A ``mujoco.MjModel``.
        body: Number of the body.
    """
    return not model.body_simple[body] or int(model.body_dofnum[body]) <= 1


def state_view(batch: Any, name: str) -> Any:
    """Returns a live view of a part of a batch's states, ``(N, …)``.

    This is ``batch.bind`` without its temporary ``MjData``, which costs more than a short
    simulation.

    Args:
        batch: A ``mujoco.batch.Batch``.
        name: Ending of one of MuJoCo's ``mjSTATE_`` constants, in lower case.
    """
    mujoco: Any = importlib.import_module("mujoco")
    whole = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    part = int(getattr(mujoco.mjtState, f"mjSTATE_{name.upper()}"))
    first = mujoco.mj_stateSize(batch.model, whole & (part - 1))
    return batch.state[:, first : first + mujoco.mj_stateSize(batch.model, part)]


def has_constraints(model: Any) -> bool:
    """Returns whether a model has anything that its constraint solver could act on.

    Args:
        model: A ``mujoco.MjModel``.
    """
    mujoco: Any = importlib.import_module("mujoco")
    may_touch = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return bool(
        model.neq
        or (may_touch and (model.ngeom or model.nflex))
        or model.jnt_limited.any()
        or model.tendon_limited.any()
        or model.dof_frictionloss.any()
        or model.tendon_frictionloss.any()
    )


def prepared_copy(
    model: Any,
    step: float,
    crisp: tuple[int, ...],
    limited: tuple[int, ...] = (),
    *,
    keeps_solver: bool = True,
) -> Any:
    """Returns a copy of a model, ready for a batch.

    The engine's own limits on commands are switched off. Commands are limited before they pass the
    action effects, and an effect such as a gain above 1 may exceed the limits.

    Args:
        model: A ``mujoco.MjModel``.
        step: Seconds per engine step.
        crisp: Degrees of freedom whose dry friction is made as hard as the engine allows. This
            changes nothing while the friction is zero, so an effect of zero strength has no
            influence.
        limited: Actuators whose force is unlimited and gets a limit, infinite for now.
        keeps_solver: Whether the constraint solver is called even if the model has no
            constraints, because parameters or effects may add some.
    """
    mujoco: Any = importlib.import_module("mujoco")
    own = copy.copy(model)
    own.opt.timestep = step
    if not keeps_solver and not has_constraints(own):
        # The same values in 7 % less time.
        own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    for actuator in limited:
        own.actuator_forcelimited[actuator] = True
        own.actuator_forcerange[actuator] = -np.inf, np.inf
    for dof in crisp:
        own.dof_solref[dof] = _CRISP_STEPS * step, 1.0
        own.dof_solimp[dof] = _CRISP_IMPEDANCE
    return own


@contextmanager
def quiet(handler: Callable[[str], None] | None = None) -> Iterator[None]:
    """Passes the engine's warnings to a function, by default one that ignores them.

    Otherwise the engine prints a warning per lost simulation and step and writes it to a file in
    the current folder. The batch counts the warnings anyway. A handler set by the user is kept.

    Args:
        handler: Function that is called with each warning.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if mujoco.get_mju_user_warning() is not None:
        yield
        return
    mujoco.set_mju_user_warning(handler or _ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _ignore(message: str) -> None:
    """Does nothing with a warning."""


def _write_shared(model: Any, array: str, place: int, value: float) -> None:
    if not array.startswith("opt."):
        getattr(model, array).reshape(-1)[place] = value
        return
    name = array.removeprefix("opt.")
    if isinstance(getattr(model.opt, name), np.ndarray):
        getattr(model.opt, name)[place] = value
    else:
        setattr(model.opt, name, value)
