"""How a rig is driven: where rollouts start, what excites them, what keeps them in range."""

from collections.abc import Sequence

import numpy as np

from hidden_rigs.excitation import EXCITATIONS
from hidden_rigs.mechanics import Array
from hidden_rigs.rig import Rig
from npdr_ppl.randomness import derived_seed

__all__ = ["commanded", "references", "starts"]


def references(
    rig: Rig, excitations: Sequence[str], num_steps: int, tail: int, seed: int
) -> Array:
    """Returns the excitations before feedback, ``(steps, actions, R)``."""
    time = rig.time_step * np.arange(num_steps, dtype=np.float64)
    result = np.zeros((num_steps + tail, len(rig.amplitudes), len(excitations)))
    for r, name in enumerate(excitations):
        for a, amplitude in enumerate(rig.amplitudes):
            generator = np.random.default_rng(derived_seed(seed, "excitation", r, a))
            signal = amplitude * EXCITATIONS[name](time, rig.band, generator)
            result[:num_steps, a, r] = signal
    # What comes after the recording decides nothing but the last reading of a fast clock.
    result[num_steps:] = result[num_steps - 1]
    return result


def starts(rig: Rig, num_rollouts: int, is_from_rest: bool, seed: int) -> tuple[Array, Array]:
    """Returns positions and velocities when the simulation begins, ``(joints, R)`` each."""
    generator = np.random.default_rng(derived_seed(seed, "start"))
    spread = np.array(rig.start_spread)[:, None]
    positions = spread * generator.uniform(-1.0, 1.0, (len(spread), num_rollouts))
    positions[:, ::2] = 0.0
    if is_from_rest:
        positions[:] = 0.0
    return positions, np.zeros_like(positions)


def commanded(rig: Rig, reference: Array, q: Array, v: Array) -> Array:
    """Returns excitation plus centring within the limits, ``(actions, R)``.

    The centring has sensors of its own, without effects and noise: it belongs to the rig and not
    to what is measured.
    """
    result = []
    for a, (centring, limit) in enumerate(zip(rig.centring, rig.limits, strict=True)):
        feedback = np.zeros_like(reference[a])
        for i, gain in enumerate(centring.position_gains):
            feedback = feedback + gain * q[i] + centring.velocity_gains[i] * v[i]
        result.append(np.clip(reference[a] - feedback, -limit, limit))
    return np.array(result)
