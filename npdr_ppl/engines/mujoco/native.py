"""All steps of a batch in one call of the engine."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.channels import Component, Reading
from npdr_ppl.engines.mujoco.stepper import ACCELERATION_STAGE, lost_simulations

__all__ = ["run_all_steps"]

Array = NDArray[np.float64]


def run_all_steps(
    batch: Any, controls: Array, substeps: int, sensors: Sequence[Component | Reading]
) -> Array:
    """Returns the true values of sensors after every control step, ``(n, steps, sensors)``.

    If the engine warns about a simulation, its values are NaN from that step on.

    Args:
        batch: A ``mujoco.batch.Batch`` of n simulations, in their initial states.
        controls: Actuator commands after all effects, for each engine step of a control step or
            one for all of them, ``(n, steps, substeps or 1, actuators)``.
        substeps: Engine steps per control step.
        sensors: The sensors to report.
    """
    mujoco: Any = importlib.import_module("mujoco")
    module: Any = importlib.import_module("mujoco.batch")
    model, num_steps = batch.model, controls.shape[1]
    num, num_actuators = len(controls), controls.shape[-1]
    controls = np.broadcast_to(controls, (num, num_steps, substeps, num_actuators))
    controls = controls.reshape(num, num_steps * substeps, num_actuators)
    # Sensors of position and velocity describe the state before an engine step. Their values after
    # the last step therefore need one more engine step.
    if any(isinstance(s, Reading) and s.stage < ACCELERATION_STAGE for s in sensors):
        controls = np.concatenate((controls, controls[:, -1:]), axis=1)
    bits = mujoco.mjtState
    spec = int(bits.mjSTATE_TIME | bits.mjSTATE_QPOS | bits.mjSTATE_QVEL)
    shape = controls.shape[:2]
    records: dict[Any, Array] = {spec: np.empty((*shape, 1 + model.nq + model.nv))}
    if any(isinstance(sensor, Reading) for sensor in sensors):
        records["sensordata"] = np.empty((*shape, model.nsensordata))
    failed = np.zeros(batch.nsim, dtype=bool)
    try:
        batch.rollout(shape[1], controls, record=list(records), out=records)
    except module.SimulationError as error:
        failed[error.ids] = True
    values = _gather(records[spec], records.get("sensordata"), model.nq, substeps, sensors)
    values = values[:, :num_steps]
    is_lost = failed | lost_simulations(batch)
    if is_lost.any():
        times = records[spec][is_lost, :, 0]
        first = np.where(failed[is_lost], 0, _first_lost(times, float(model.opt.timestep)))
        steps = np.arange(num_steps)
        values[is_lost] = np.where(
            (steps >= first[:, None] // substeps)[..., None], np.nan, values[is_lost]
        )
    return values


def _gather(
    states: Array,
    sensordata: Array | None,
    num_positions: int,
    substeps: int,
    sensors: Sequence[Component | Reading],
) -> Array:
    """Picks each sensor's column at the last engine step of every control step."""
    last = slice(substeps - 1, None, substeps)
    columns = [
        1 + sensor.address + (num_positions if sensor.is_velocity else 0)
        for sensor in sensors
        if isinstance(sensor, Component)
    ]
    if len(columns) == len(sensors):
        first, width = columns[0], len(columns)
        if columns == list(range(first, first + width)):
            return states[:, last, first : first + width].copy()
        return states[:, last][..., columns]
    assert sensordata is not None
    num_steps = (states.shape[1]) // substeps
    values = np.empty((len(states), num_steps, len(sensors)))
    for i, sensor in enumerate(sensors):
        if isinstance(sensor, Component):
            place = 1 + sensor.address + (num_positions if sensor.is_velocity else 0)
            column = states[:, last, place]
        else:
            lag = 0 if sensor.stage == ACCELERATION_STAGE else 1
            column = sensordata[:, substeps - 1 + lag :: substeps, sensor.address]
        count = min(num_steps, column.shape[1])
        values[:, :count, i] = column[:, :count]
    return values


def _first_lost(times: Array, step: float) -> NDArray[np.int64]:
    """Returns the engine step at which each simulation was lost, at most one too early.

    A lost simulation is reset or repeats its last record. In both cases its recorded time is wrong
    from this step or the next one on.

    Args:
        times: Recorded times of lost simulations, ``(n, engine steps)``.
        step: Seconds per engine step.
    """
    right = step * (1.0 + np.arange(times.shape[1]))
    is_wrong = ~(np.abs(times - right) < 0.5 * step)
    first = np.where(is_wrong.any(axis=1), is_wrong.argmax(axis=1), times.shape[1])
    return np.maximum(first - 1, 0)
