"""Batches of MuJoCo simulations whose parameters differ."""

import copy
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from npdr_ppl.engines.mujoco.parameters import Assignments

__all__ = ["make_batch", "quiet", "with_crisp_friction"]

# MuJoCo's friction yields: it decays a joint's speed over the time constant of ``solref`` and lets
# a stuck joint creep. These values are the hardest that it admits: the greatest impedance, and a
# time constant of two steps, with which the speed is gone after one.
_CRISP_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_CRISP_STEPS = 2.0


def make_batch(
    model: Any, assignments: Assignments, num_simulations: int, num_threads: int
) -> Any:
    """Returns a ``mujoco.batch.Batch`` whose models hold the assigned values.

    Values that all simulations share are written into ``model``; the others are expanded.

    Args:
        model: A ``mujoco.MjModel`` of the caller's own.
        assignments: Values, numbers or ``(N,)``.
        num_simulations: N.
        num_threads: Threads to run on.
    """
    mujoco: Any = importlib.import_module("mujoco")
    batch_module: Any = importlib.import_module("mujoco.batch")
    shared = {key: float(value) for key, value in assignments.items() if value.numel() == 1}
    # Constants such as inverse inertias follow from some fields; deriving them costs microseconds
    # per simulation, so only where such a field was written.
    followed = set(getattr(mujoco.MjModel, "_setconst_inputs", ())) or {a for a, _ in assignments}
    for (array, place), value in shared.items():
        _write_shared(model, array, place, value)
    if any(array in followed for array, _ in shared):
        mujoco.mj_setConst(model, mujoco.MjData(model))
    batch = batch_module.Batch(model, num_simulations, num_threads)
    own = {key: value for key, value in assignments.items() if key not in shared}
    for (array, place), value in own.items():
        batch.expand(array).reshape(num_simulations, -1)[:, place] = value.numpy()
    if any(array in followed for array, _ in own):
        # A simulation whose values have no such constants is lost, and its warnings say so.
        try:
            batch.set_const()
        except batch_module.SimulationError:
            pass
    return batch


def with_crisp_friction(model: Any, dofs: list[int], assignments: Assignments, step: float) -> Any:
    """Makes dry friction as hard as the engine admits where the file has none of its own.

    Without friction nothing changes, so that an effect of no strength changes nothing.

    Args:
        model: A ``mujoco.MjModel`` of the caller's own.
        dofs: Degrees of freedom at which effects add dry friction.
        assignments: What is written into the model.
        step: Seconds per engine step.
    """
    for dof in dofs:
        if model.dof_frictionloss[dof] == 0.0 and ("dof_frictionloss", dof) not in assignments:
            model.dof_solref[dof] = _CRISP_STEPS * step, 1.0
            model.dof_solimp[dof] = _CRISP_IMPEDANCE
    return model


def private_copy(model: Any, step: float) -> Any:
    """Returns a copy of a model with another time step.

    Commands are limited before they pass the action effects, so the engine's own limit is off: a
    gain that is too high may well exceed it.
    """
    mujoco: Any = importlib.import_module("mujoco")
    own = copy.copy(model)
    own.opt.timestep = step
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    return own


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps the engine from printing a line, and writing one to a file, per lost simulation.

    A handler of the user's own stays.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if mujoco.get_mju_user_warning() is not None:
        yield
        return
    mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _ignore(message: str) -> None:
    """Does nothing with a warning; the batch counts them."""


def _write_shared(model: Any, array: str, place: int, value: float) -> None:
    if not array.startswith("opt."):
        getattr(model, array).reshape(-1)[place] = value
        return
    name = array.removeprefix("opt.")
    if isinstance(getattr(model.opt, name), np.ndarray):
        getattr(model.opt, name)[place] = value
    else:
        setattr(model.opt, name, value)
