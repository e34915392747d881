"""Band-limited commands that begin and end at rest: truncated Fourier series in a window.

The command of an action is

    u(t) = u₀ + g w(t) Σ_k (a_k sin 2π k t / T + b_k cos 2π k t / T),        k ≤ T · bandwidth

with the command u₀ at rest, a window w that rises and falls smoothly, and an amplitude g: a share
of the greatest one that keeps the limits of the command, its rate and its acceleration (Swevers et
al., Optimal robot excitation and identification, 1997). Where u₀ is close to a limit, the sum gets
a constant, so that it is about the middle of the range.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.planning.limits import ActionLimits, Limits
from npdr_ppl.planning.settings import PLANNING

__all__ = ["Candidate", "Excitations"]

Array = NDArray[np.float64]

_SHAPES = ("flat", "low", "steps", "chirp", "triangle", "reversals")
"""Shapes from which the search begins."""


@dataclass(frozen=True)
class Candidate:
    """Commands and a start, before they are scaled to the limits.

    Attributes:
        coefficients: Coefficients a and b, ``(A, 2 K)``.
        amplitudes: Shares of the greatest permitted amplitude, ``(A,)``, in (0, 1].
        start: Start of each channel, as a share of its permitted range, ``(C,)``, in [0, 1].
    """

    coefficients: Array
    amplitudes: Array
    start: Array


class Excitations:
    """Makes candidates and turns them into commands within the limits.

    Args:
        limits: The limits.
        generator: Source of randomness.
    """

    def __init__(self, limits: Limits, generator: np.random.Generator) -> None:
        self.limits = limits
        self._generator = generator
        num, duration = limits.num_steps, limits.num_steps * limits.time_step
        time = np.arange(num) * limits.time_step
        self.num_waves = max(1, math.floor(limits.bandwidth * duration))
        ramp = min(0.25 * duration, 0.5 / limits.bandwidth)
        rise = np.clip(np.minimum(time, time[-1] - time) / ramp, 0.0, 1.0)
        self._window = 0.5 - 0.5 * np.cos(np.pi * rise)
        self._time = time / duration

    def commands(self, candidate: Candidate) -> Array:
        """Returns the commands of a candidate, ``(T, A)``, in the actions' units."""
        columns = []
        for row, share, action in zip(
            candidate.coefficients,
            candidate.amplitudes,
            self.limits.actions.values(),
            strict=True,
        ):
            command = action.start + share * self._greatest(self._series(row), action)
            columns.append(np.clip(command, action.min, action.max))  # after rounding
        return np.stack(columns, axis=-1)

    def start(self, candidate: Candidate) -> Array:
        """Returns the measured values at the start, ``(C,)``, in the channels' units."""
        low = np.array([c.start_min for c in self.limits.channels.values()])
        high = np.array([c.start_max for c in self.limits.channels.values()])
        return np.clip(low + candidate.start * (high - low), low, high)  # after rounding

    def random(self, number: int) -> list[Candidate]:
        """Returns candidates of random shapes, in turn with other amplitudes."""
        result = []
        for index in range(number):
            rows = [self._shape() for _ in self.limits.actions]
            amplitude = PLANNING.amplitudes[index % len(PLANNING.amplitudes)]
            num_channels = len(self.limits.channels)
            result.append(
                Candidate(
                    np.stack(rows) if rows else np.zeros((0, 2 * self.num_waves)),
                    np.full(len(rows), amplitude),
                    self._generator.choice((0.0, 0.5, 1.0), num_channels)
                    if index % 2
                    else self._generator.random(num_channels),
                )
            )
        return result

    def changed(self, candidate: Candidate, step: float) -> Candidate:
        """Returns a candidate close to another one.

        Args:
            candidate: The other one.
            step: Standard deviation relative to the coefficients' size.
        """
        generator, rows = self._generator, candidate.coefficients
        size = np.sqrt(np.mean(rows**2, axis=-1, keepdims=True))
        chosen = generator.random(rows.shape) < generator.choice((0.1, 0.3, 1.0))
        coefficients = rows + step * size * chosen * generator.standard_normal(rows.shape)
        factor = np.exp(0.5 * step * generator.standard_normal(len(rows)))
        moved = 0.5 * step * generator.standard_normal(len(candidate.start))
        return Candidate(
            coefficients,
            np.clip(candidate.amplitudes * factor, 0.01, 1.0),
            np.clip(candidate.start + moved, 0.0, 1.0),
        )

    def mixed(self, one: Candidate, other: Candidate) -> Candidate:
        """Returns a candidate with some commands of one and the others of another."""
        takes = self._generator.random(len(one.coefficients)) < 0.5
        return Candidate(
            np.where(takes[:, None], one.coefficients, other.coefficients),
            np.where(takes, one.amplitudes, other.amplitudes),
            one.start if self._generator.random() < 0.5 else other.start,
        )

    def weaker(self, candidate: Candidate, factor: float) -> Candidate:
        """Returns a candidate with smaller amplitudes."""
        return replace(candidate, amplitudes=factor * candidate.amplitudes)

    def _greatest(self, series: Array, action: ActionLimits) -> Array:
        """Returns the greatest deviation from the command at rest within the limits, ``(T,)``."""
        low, high = action.min - action.start, action.max - action.start
        step, tiny = self.limits.time_step, 1e-300
        if min(high, -low) < PLANNING.least_room * (high - low):
            size = 0.5 * (high - low) / max(float(np.abs(series).max()), tiny)
            deviation = self._window * (0.5 * (low + high) + size * series)
        else:
            shape = self._window * series
            largest, smallest = float(shape.max()), float(shape.min())
            deviation = shape * min(high / max(largest, tiny), -low / max(-smallest, tiny))
        rate = np.diff(deviation, prepend=0.0, append=0.0) / step
        change = np.abs(np.diff(rate)) / step
        return deviation * min(
            1.0,
            action.max_rate / max(float(np.abs(rate).max()), tiny),
            action.max_acceleration / max(float(change.max()), tiny),
        )

    def _shape(self) -> Array:
        """Returns coefficients of a random shape, ``(2 K,)``."""
        generator, num = self._generator, self.num_waves
        kind = _SHAPES[int(generator.integers(len(_SHAPES)))]
        if kind in ("flat", "low"):
            order = np.arange(1, num + 1)
            size = np.ones(num) if kind == "flat" else 1.0 / order
            phase = generator.uniform(0.0, 2.0 * np.pi, num)
            size = size * (generator.random(num) < generator.choice((0.3, 1.0)))
            size[int(generator.integers(num))] += 1e-3
            return np.concatenate((size * np.sin(phase), size * np.cos(phase)))
        found = np.fft.rfft(self._drawn(kind))[1 : num + 1]
        return 2.0 / len(self._time) * np.concatenate((-found.imag, found.real))

    def _series(self, coefficients: Array) -> Array:
        """Returns a Fourier series of coefficients ``(2 K,)``, ``(T,)``."""
        num, steps = self.num_waves, len(self._time)
        spectrum = np.zeros(steps // 2 + 1, dtype=complex)
        spectrum[1 : num + 1] = coefficients[num:] - 1j * coefficients[:num]
        if 2 * num == steps:
            spectrum[-1] *= 2.0  # irfft counts half the sampling rate once, other waves twice
        return 0.5 * steps * np.fft.irfft(spectrum, steps)

    def _drawn(self, kind: str) -> Array:
        """Returns a shape with all frequencies, ``(T,)``, of which a series keeps the band."""
        generator, time = self._generator, self._time
        cycles = generator.uniform(1.0, max(1.5, 0.5 * self.num_waves))
        if kind == "steps":
            levels = generator.uniform(-1.0, 1.0, int(2 * cycles) + 2)
            return levels[(time * len(levels)).astype(int)]
        if kind == "chirp":
            begin, end = generator.permutation((0.5, float(self.num_waves)))
            return np.sin(2.0 * np.pi * (begin * time + 0.5 * (end - begin) * time**2))
        phase = (cycles * time + generator.random()) % 1.0
        if kind == "reversals":
            return np.where(phase < 0.5, 1.0, -1.0)
        return 4.0 * np.abs(phase - 0.5) - 1.0
