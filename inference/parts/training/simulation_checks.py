"""Checks of simulations that all backends use."""

import logging
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.inference.base import Problem

__all__ = ["check_problem", "check_restored", "finite_rows"]

logger = logging.getLogger(__name__)


def check_problem(problem: Problem) -> None:
    """Checks the problem before any simulation.

    Raises:
        ShapeError: There are no parameters, or the features are not a vector.
        BackendError: The observation is not finite.
    """
    if problem.num_parameters < 1:
        raise ShapeError(f"There must be a parameter to infer, got {problem.num_parameters=}.")
    observation = problem.observation
    if problem.build_network is None and (observation.ndim != 1 or not len(observation)):
        raise ShapeError(
            "Features of an observation must be a vector (F,) unless a network is trained on raw "
            f"arrays; got {tuple(observation.shape)}."
        )
    if not observation.isfinite().all():
        raise BackendError(
            f"{int((~observation.isfinite()).sum())} of {observation.numel()} features of the "
            "observation are not finite; leave them out or choose another embedding."
        )


def finite_rows(
    problem: Problem, z: Tensor, x: Tensor, min_rows: int
) -> tuple[Tensor, Tensor, int]:
    """Drops failed simulations, with a warning.

    Args:
        problem: The problem simulated.
        z: Parameters, ``(n, d)``.
        x: Features, ``(n,) + observation.shape``; rows that are not finite failed.
        min_rows: Successful simulations needed.

    Returns:
        The parameters and features of the other rows, in float32, and the number dropped.

    Raises:
        ShapeError: The shapes do not fit the problem or each other.
        BackendError: Parameters are not finite, or too few simulations are left.
    """
    if z.ndim != 2 or z.shape[1] != problem.num_parameters:
        raise ShapeError(
            f"Parameters must have shape (n, {problem.num_parameters}), got {tuple(z.shape)}."
        )
    expected = (len(z), *problem.observation.shape)
    if tuple(x.shape) != expected:
        raise ShapeError(f"Features must have shape {expected}, got {tuple(x.shape)}.")
    if not z.isfinite().all():
        raise BackendError("Simulated parameters must be finite; some are NaN or infinite.")
    x = x.to(torch.float32)  # before the test: values that overflow float32 are not usable either
    finite = x.flatten(1).isfinite().all(1)
    num_failed = len(z) - int(finite.sum())
    if num_failed:
        logger.warning("%d of %d simulations failed.", num_failed, len(z))
    if len(z) - num_failed < min_rows:
        raise BackendError(
            f"{num_failed} of {len(z)} simulations failed (their features are not finite); at "
            f"least {min_rows} must succeed. Check the simulator over the whole prior."
        )
    return z[finite].to(torch.float32), x[finite], num_failed


def check_restored(
    name: str, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
) -> None:
    """Checks that a state read from disk belongs to the backend and to the current problem.

    Args:
        name: The backend's name.
        problem: The problem to continue with.
        tensors: The state's tensors, simulated parameters ``z`` and features ``x`` among them.
        values: The state's other values, the name of its ``backend`` among them.

    Raises:
        ShapeError: It is the state of another problem.
        BackendError: It is the state of another backend.
    """
    if values.get("backend") != name:
        raise BackendError(f"This state is of backend {values.get('backend')!r}, not {name}.")
    z, x = tensors["z"], tensors["x"]
    if z.shape[1] != problem.num_parameters or x.shape[1:] != problem.observation.shape:
        raise ShapeError(
            f"The state holds parameters {tuple(z.shape)} and features {tuple(x.shape)}; the "
            f"problem has {problem.num_parameters} parameters and features "
            f"{tuple(problem.observation.shape)}."
        )
