"""The arrays behind rollouts: conversion, and whether they fit each other."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import checks

if TYPE_CHECKING:
    from npdr_ppl.rollouts.container import Rollouts

__all__ = ["Array", "as_arrays", "check_arrays", "check_columns", "frozen"]

Array = NDArray[np.float64]


def frozen(values: ArrayLike) -> Array:
    """Returns a read-only float64 copy."""
    copied = np.array(values, dtype=np.float64)
    copied.flags.writeable = False
    return copied


def as_arrays(values: Any, name: str) -> tuple[Array, ...]:
    """Returns one float64 array per rollout.

    Args:
        values: A stack, or a sequence of arrays or tensors.
        name: What they are, for messages.

    Raises:
        DataError: They are not numbers.
    """
    try:
        return tuple(
            np.asarray(v.detach().cpu() if isinstance(v, Tensor) else v, dtype=np.float64)
            for v in values
        )
    except (TypeError, ValueError):
        raise DataError(f"{name} should be one array of numbers per rollout.") from None


def check_columns(rollouts: "Rollouts") -> None:
    """Raises a DataError where names, units, or the time step are wrong."""
    names = (*rollouts.channel_names, *rollouts.action_names)
    checks.check_names(names, "column")
    taken = set(checks.RESERVED_NAMES) & set(names)
    if taken:
        raise DataError(f"{min(taken)} is a reserved name, not a channel's or an action's.")
    if not rollouts.channel_names:
        raise DataError("the data have no channels, only actions.")
    if not rollouts.readings:
        raise DataError("the data have no rollouts.")
    if not (math.isfinite(rollouts.time_step) and rollouts.time_step > 0):
        raise DataError(f"the time step is {rollouts.time_step} s, but it must be positive.")
    for field, units, columns in (
        ("channel_units", rollouts.channel_units, rollouts.channel_names),
        ("action_units", rollouts.action_units, rollouts.action_names),
    ):
        if len(units) not in (0, len(columns)):
            raise DataError(f"{field} has {len(units)} entries for {len(columns)} columns.")


def check_arrays(rollouts: "Rollouts") -> None:
    """Raises a DataError where shapes do not fit, values are not finite, or time is not even."""
    per_rollout: dict[str, Sequence[Array] | None] = {
        "actions": rollouts.actions,
        "time": rollouts.time,
        "rewards": rollouts.rewards,
    }
    for name, arrays in per_rollout.items():
        if arrays is not None and len(arrays) != len(rollouts.readings):
            raise DataError(
                f"there are {len(rollouts.readings)} rollouts of readings, but {len(arrays)} of "
                f"{name}."
            )
    for index, readings in enumerate(rollouts.readings):
        where = f"rollout {index}"
        steps = len(readings) - 1
        if steps < 1:
            raise DataError(
                f"{where} has {steps + 1} row, but at least two are needed for one step."
            )
        actions, time = rollouts.actions[index], rollouts.time[index]
        wanted = {
            "readings": (readings, (steps + 1, len(rollouts.channel_names))),
            "actions": (actions, (steps, len(rollouts.action_names))),
            "time": (time, (steps + 1,)),
        }
        if rollouts.rewards is not None:
            wanted["rewards"] = (rollouts.rewards[index], (steps,))
        for name, (values, shape) in wanted.items():
            if values.shape != shape:
                raise DataError(
                    f"{name} of {where} should have shape {shape}, got {values.shape}."
                )
        checks.check_finite(readings, rollouts.channel_names, where)
        checks.check_finite(actions, rollouts.action_names, where)
        checks.check_finite(time[:, None], ("time",), where)
        if rollouts.rewards is not None:
            checks.check_finite(rollouts.rewards[index][:, None], ("reward",), where)
        checks.check_time(time, where)
    found = checks.canonical_time_step(rollouts.time)
    if abs(found - rollouts.time_step) > checks.MAX_RATE_DIFFERENCE * rollouts.time_step:
        raise DataError(
            f"time stamps are {found:.6g} s apart, but the time step is said to be "
            f"{rollouts.time_step:.6g} s."
        )
