"""The demonstration: a recording from another engine, and the posterior it leads to."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import InitialState
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.fit import fit
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.progress import Reporter

__all__ = ["TRUTH", "Demonstration", "record_rig", "run_demo"]

TRUTH = {
    "gravity": 9.81,
    "motor_resistance": 7.4,
    "motor_constant": 0.046,
    "arm_mass": 0.110,
    "arm_length": 0.093,
    "pole_mass": 0.020,
    "pole_length": 0.141,
    "arm_damping": 4e-4,
    "pole_damping": 3e-5,
}
"""What the rig is in truth, by domain parameter: off the nominal values by 10 to 25 %."""

NUM_STEPS = 1_000
SEGMENT_LENGTH = 100
EMBEDDING = "all~25"
ROUNDS = 3
NUM_SIMULATIONS = 1_500


@dataclass(frozen=True)
class Demonstration:
    """What the demonstration came to.

    Attributes:
        posterior: The posterior.
        result: The content of ``fit.json``.
        test: The held-out rollout.
        truth: True parameters, empty for a recording of one's own.
    """

    posterior: Posterior
    result: dict[str, Any]
    test: Rollouts
    truth: dict[str, float]


def run_demo(
    out: Path,
    *,
    data: Path | None = None,
    initial_state: InitialState = "estimated",
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> Demonstration:
    """Fits the Furuta pendulum to a recording and holds its last rollout out.

    Args:
        out: Folder for results.
        data: A recording of one's own; ``None`` makes one in MuJoCo.
        initial_state: State at a segment's start.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
    """
    out.mkdir(parents=True, exist_ok=True)
    if data is None:
        rollouts = record_rig()
        rollouts.to_csv(out / "recording.csv")
    else:
        rollouts = Rollouts.load(data)
        rollouts.check(Furuta.sensors, Furuta.actions)
    last = len(rollouts) - 1
    train, test = (rollouts[list(range(last))], rollouts[[last]]) if last else (rollouts, rollouts)
    posterior, result = fit(
        furuta,
        train,
        test,
        out=out,
        rounds=ROUNDS,
        num_simulations=NUM_SIMULATIONS,
        seed=seed,
        options=BindingOptions(EMBEDDING, SEGMENT_LENGTH, initial_state, "float32"),
        progress=progress,
    )
    return Demonstration(posterior, result, test, TRUTH if data is None else {})


def record_rig() -> Rollouts:
    """Records four rollouts of a rig in MuJoCo, 2 s at 500 Hz each."""
    rig = FurutaRig(parameters=TRUTH)
    recordings = [
        rig.run(_excitation(amplitude, frequency), NUM_STEPS)
        for amplitude, frequency in ((2.0, 1.6), (3.0, 2.3), (1.5, 0.9), (2.5, 1.2))
    ]
    return Rollouts.from_arrays(
        readings=[recording.readings for recording in recordings],
        actions=[recording.voltage[:, None] for recording in recordings],
        channel_names=tuple(channel.name for channel in Furuta.sensors),
        action_names=("voltage",),
        time_step=Furuta.time_step,
        channel_units=tuple(channel.unit for channel in Furuta.sensors),
        action_units=("V",),
    )


def _excitation(amplitude: float, frequency: float) -> Any:
    """Returns two sines, and a spring that keeps the arm in its range."""

    def voltage(readings: np.ndarray, time: float) -> float:
        turn = 2 * math.pi * frequency * time
        sines = math.sin(turn) + 0.4 * math.sin(2.7 * turn + 0.5)
        return amplitude * sines - 2.0 * float(readings[0])

    return voltage
