"""Laws of effects that MuJoCo has itself, as numbers of its model.

The engine integrates them better than a force that is held for a step: damping implicitly, springs
at every stage. And all steps of a batch are one call.
"""

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.engines.mujoco.ports import ForcePort
from npdr_ppl.language.effects import ForceEffect

__all__ = ["is_native", "native_law"]


def is_native(
    model: Any, port: ForcePort, effect: ForceEffect, bound: set[tuple[str, int]]
) -> bool:
    """Returns whether the engine has an effect's law at a joint.

    Args:
        model: A ``mujoco.MjModel``.
        port: The joint.
        effect: The effect at the joint.
        bound: Arrays and places that parameters set.
    """
    mujoco: Any = importlib.import_module("mujoco")
    off = int(model.opt.disableflags)
    # A file has one damping for all axes of a floating body.
    if port.port.is_floating or not _has_own_law(effect):
        return False
    if effect.standard_law == "damping":
        return not off & int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
    if effect.standard_law == "dry friction":
        return not off & int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    if effect.standard_law != "spring" or off & int(mujoco.mjtDisableBit.mjDSBL_SPRING):
        return False
    # A joint has one spring with one rest position.
    stiffness = [model.jnt_stiffness[port.joint], *np.atleast_1d(_poly(model)[port.joint])]
    return not np.any(stiffness) and ("jnt_stiffness", port.joint) not in bound


def _has_own_law(effect: ForceEffect) -> bool:
    """Returns whether the law is that of the class that declares it as a standard one."""
    owner = next(cls for cls in type(effect).__mro__ if "standard_law" in vars(cls))
    laws = "force", "dry_friction"
    return all(getattr(type(effect), name) is getattr(owner, name) for name in laws)


def _poly(model: Any) -> Any:
    """Returns the higher coefficients of springs, which earlier versions do not have."""
    return getattr(model, "jnt_stiffnesspoly", np.zeros((model.njnt, 1)))


def native_law(
    model: Any,
    port: ForcePort,
    effect: ForceEffect,
    values: Mapping[str, Tensor],
    assignments: Assignments,
) -> Assignments:
    """Returns the numbers of a model that stand for an effect, see :func:`is_native`.

    Args:
        model: A ``mujoco.MjModel``.
        port: The joint.
        effect: The effect.
        values: Its parameters by short name, in float64.
        assignments: What else is written into the model.
    """
    if effect.standard_law == "damping":
        key = "dof_damping", port.velocity
        # Negative damping would drive the joint.
        total = present(model, *key, assignments) + values["damping"]
        return {key: total.clamp_min(0.0)}
    if effect.standard_law == "dry friction":
        key = "dof_frictionloss", port.velocity
        return {key: present(model, *key, assignments) + values["magnitude"]}
    assert port.position is not None  # of a hinge or slide
    return {
        ("jnt_stiffness", port.joint): values["stiffness"],
        ("qpos_spring", port.position): values["rest"],
    }
