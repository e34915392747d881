"""Commands that excite a rig, drawn by seed, in units of the greatest amplitude used."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["EXCITATIONS", "Band"]


@dataclass(frozen=True)
class Band:
    """Frequencies of an excitation, in Hz.

    Attributes:
        lower: Least frequency.
        upper: Greatest frequency.
    """

    lower: float
    upper: float


def multisine(time: Array, band: Band, generator: np.random.Generator) -> Array:
    """Returns eight sines of random frequency and phase whose peak is 1, ``(K,)``."""
    frequencies = np.exp(generator.uniform(math.log(band.lower), math.log(band.upper), 8))
    phases = generator.uniform(0.0, 2.0 * math.pi, 8)
    total = np.sin(2.0 * math.pi * frequencies * time[:, None] + phases).sum(axis=-1)
    return total / np.abs(total).max()


def chirp(time: Array, band: Band, generator: np.random.Generator) -> Array:
    """Returns a sine that sweeps the band up or down, its amplitude breathing, ``(K,)``."""
    ends = (band.lower, band.upper) if generator.random() < 0.5 else (band.upper, band.lower)
    duration = time[-1] + time[1]
    cycles = ends[0] * time + 0.5 * (ends[1] - ends[0]) / duration * time**2
    phase = generator.uniform(0.0, 2.0 * math.pi)
    breath = generator.uniform(0.0, 2.0 * math.pi)
    amplitude = 0.75 + 0.25 * np.sin(2.0 * math.pi * 0.35 * time + breath)
    return amplitude * np.sin(2.0 * math.pi * cycles + phase)


def steps(time: Array, band: Band, generator: np.random.Generator) -> Array:
    """Returns levels of random height and length, each taken back at once, ``(K,)``.

    Four levels +, −, −, + of one height and length bring a free mass back to where it was.
    """
    result = np.zeros_like(time)
    begin = 0.0
    while begin < time[-1]:
        # Half a period each; a step has more of low frequencies than the sine of its period.
        middle = math.sqrt(band.lower * band.upper)
        length = 0.5 / generator.uniform(middle, band.upper)
        height = generator.uniform(0.35, 1.0) * (1.0 if generator.random() < 0.5 else -1.0)
        for sign in (1.0, -1.0, -1.0, 1.0):
            result[(time >= begin) & (time < begin + length)] = sign * height
            begin += length
    return result


EXCITATIONS: dict[str, Callable[[Array, Band, np.random.Generator], Array]] = {
    "multisine": multisine,
    "steps": steps,
    "chirp": chirp,
}
"""Excitations by name."""
