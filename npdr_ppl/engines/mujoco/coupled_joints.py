"""Joints that equality constraints of an MJCF file tie to others, such as fingers of a gripper."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from npdr_ppl.engines.mujoco.channels import Component
from npdr_ppl.language.channels import Channel, Follower

__all__ = ["coupled_joints"]


def coupled_joints(
    model: Any, components: Sequence[Component], states: Sequence[Channel]
) -> tuple[Follower, ...]:
    """Returns which positions follow from others.

    With positions measured from where the file has them, y = p(x) with a polynomial p of degree
    four. If it is linear, x follows from y as well.

    Args:
        model: A ``mujoco.MjModel``.
        components: Where MuJoCo stores each state.
        states: The states.
    """
    mujoco: Any = importlib.import_module("mujoco")
    names = {
        component.address: state.name
        for component, state in zip(components, states, strict=True)
        if not component.is_velocity
    }
    result = []
    for number in range(model.neq):
        is_joint = int(model.eq_type[number]) == int(mujoco.mjtEq.mjEQ_JOINT)
        pair = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        if not (is_joint and model.eq_active0[number]) or min(pair) < 0:
            continue
        (own, other) = (int(model.jnt_qposadr[joint]) for joint in pair)
        if own not in names or other not in names:
            continue
        start, start_of_other = float(model.qpos0[own]), float(model.qpos0[other])
        in_file = np.polynomial.Polynomial(model.eq_data[number, :5])
        shifted = in_file(np.polynomial.Polynomial([-start_of_other, 1.0])) + start
        constant, slope, *curved = (float(c) for c in shifted.coef)
        result.append(Follower(names[own], names[other], (constant, slope, *curved)))
        if slope != 0.0 and not any(curved):
            back = 0.0 - constant / slope, 1.0 / slope
            result.append(Follower(names[other], names[own], back))
    return tuple(result)
