"""Velocities and accelerations from position measurements, by zero-phase low-pass filters.

This is the usual procedure of robot identification:

1. Positions pass a low-pass filter forwards and backwards, which causes no phase shift, and are
   differentiated by central differences.
2. Both sides of the equations of motion pass the same second low-pass filter (the *parallel
   filter*). It keeps the two sides equal and removes the noise that differentiation amplified.
3. Only as many rows are kept as are independent after that filter.

Reference: M. Gautier, A. Janot, P.-O. Vandanjon, A new closed-loop output error method for
parameter identification of robot dynamics, 2013, and the references there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal

from npdr_ppl.errors import DataError, TooShortError

__all__ = ["Derivatives", "Smoothing", "cutoffs", "differentiate", "held_actions", "thin"]

Array = NDArray[np.float64]

ORDER = 4
"""Order of the Butterworth filters; the forward and backward passes together have order 8."""

PARALLEL_RATIO = 0.4
"""Ratio of the parallel filter's cut-off to that of the positions' filter. At 0.4 of its cut-off
the positions' filter still passes 0.9993 of the amplitude. Usual cut-offs are two and five times
the bandwidth of the motion."""

GREATEST_CUTOFF = 0.2
"""Greatest automatic cut-off, as a fraction of the sampling rate. The error of the difference
formula is 1 % there and 1e-5 at the parallel filter's cut-off."""

FLOOR_RATIO = 4.0
"""Ratio of power to the noise floor above which a frequency belongs to the motion."""

NUM_SEGMENTS = 8
"""A rollout is divided by this number to get the length of the half-overlapping stretches whose
spectra are averaged."""

STENCIL = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
"""Central difference of sixth order."""

EDGE_PERIODS = 2.0
"""Length dropped at each end, where filters have not settled, in periods of the parallel filter's
cut-off frequency."""

LEAST_ROWS = 64
"""Least number of samples of a rollout that can be filtered."""


@dataclass(frozen=True)
class Smoothing:
    """Cut-off frequencies of the two filters.

    Attributes:
        position_cutoff: Cut-off of the positions' filter, in Hz; ``None`` for the frequency at
            which the positions' spectrum reaches the noise floor.
        parallel_cutoff: Cut-off of the parallel filter, in Hz; ``None`` for 0.4 times the other.
    """

    position_cutoff: float | None = None
    parallel_cutoff: float | None = None

    def __post_init__(self) -> None:
        """Checks the signs."""
        for name in ("position_cutoff", "parallel_cutoff"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise DataError(f"{name} must be a positive frequency in Hz, got {value}.")


@dataclass(frozen=True)
class Derivatives:
    """Smoothed positions and their derivatives, ``(T, J)`` each, in units, units/s, units/s²."""

    positions: Array
    velocities: Array
    accelerations: Array


def cutoffs(
    positions: Sequence[Array], time_step: float, smoothing: Smoothing
) -> tuple[float, float]:
    """Returns the cut-offs in Hz of the positions' and of the parallel filter.

    The automatic cut-off is the median over rollouts of the frequency up to which the spectrum of
    some joint is above its noise floor. The floor is the median of the spectrum's upper half.

    Args:
        positions: Measured positions, ``(T, J)`` per rollout.
        time_step: Seconds between measurements.
        smoothing: The cut-offs that the user chose.

    Raises:
        DataError: A rollout is too short, or a cut-off is not below half the sampling rate.
    """
    if min(len(values) for values in positions) < LEAST_ROWS:
        raise TooShortError(
            f"Accelerations are estimated from rollouts of at least {LEAST_ROWS} samples, got "
            f"one of {min(len(values) for values in positions)}."
        )
    chosen = smoothing.position_cutoff
    if chosen is None:
        bandwidths = [
            max(_bandwidth(channel, time_step) for channel in values.T) for values in positions
        ]
        chosen = min(float(np.median(bandwidths)), GREATEST_CUTOFF / time_step)
    parallel = smoothing.parallel_cutoff or PARALLEL_RATIO * chosen
    for name, value in (("position", chosen), ("parallel", parallel)):
        if value >= 0.5 / time_step:
            raise DataError(
                f"The {name} cut-off must be below half the sampling rate, "
                f"{0.5 / time_step:.6g} Hz, got {value:.6g} Hz."
            )
    return chosen, parallel


def differentiate(positions: Array, time_step: float, cutoff: float) -> Derivatives:
    """Smooths and differentiates measured positions.

    Args:
        positions: Measured positions, ``(T, J)``.
        time_step: Seconds between measurements.
        cutoff: Cut-off of the low-pass, in Hz.
    """
    smooth = _low_pass(positions, time_step, cutoff)
    velocities = _difference(smooth, time_step)
    return Derivatives(smooth, velocities, _difference(velocities, time_step))


def thin(rows: Array, time_step: float, cutoff: float) -> Array:
    """Passes columns through the parallel filter and keeps as many rows as are independent.

    Args:
        rows: Columns of both sides of the equations, ``(T, ...)``.
        time_step: Seconds between rows.
        cutoff: Cut-off of the filter, in Hz.

    Returns:
        Rows sampled at twice the cut-off, without both ends, ``(n, ...)``; n may be 0.
    """
    edge = int(np.ceil(EDGE_PERIODS / (cutoff * time_step)))
    stride = max(1, int(0.5 / (cutoff * time_step)))
    return _low_pass(rows, time_step, cutoff)[edge : len(rows) - edge : stride]


def held_actions(actions: Array) -> Array:
    """Returns the effective command at each measurement, ``(T + 1, A)``.

    A command is held from one measurement to the next, so it changes exactly at a measurement.
    The weights (−1, 13, 13, −1)/24 reproduce the held signal to fourth order in frequency.

    Args:
        actions: Commands, ``(T, A)``.
    """
    padded = np.concatenate((actions[:1], actions[:1], actions, actions[-1:], actions[-1:]))
    outer, inner = padded[:-3] + padded[3:], padded[1:-2] + padded[2:-1]
    return (13.0 * inner - outer) / 24.0


def _low_pass(values: Array, time_step: float, cutoff: float) -> Array:
    sections = signal.butter(ORDER, cutoff, fs=1.0 / time_step, output="sos")
    # Odd extension over two periods lets the filter settle outside the data.
    padding = min(len(values) - 1, int(np.ceil(EDGE_PERIODS / (cutoff * time_step))))
    smooth = signal.sosfiltfilt(sections, values, axis=0, padlen=padding)
    return np.ascontiguousarray(smooth)


def _difference(values: Array, time_step: float) -> Array:
    """Differentiates along the first axis; the first and last three rows are less accurate."""
    rates = np.gradient(values, axis=0)
    rates[3:-3] = np.tensordot(sliding_window_view(values, 7, axis=0), STENCIL, axes=1)
    return rates / time_step


def _bandwidth(channel: Array, time_step: float) -> float:
    """Returns the frequency in Hz at which a channel's spectrum first reaches its noise floor."""
    size = max(LEAST_ROWS, len(channel) // NUM_SEGMENTS)
    frequencies, power = signal.welch(
        signal.detrend(channel), fs=1.0 / time_step, nperseg=size, detrend="linear"
    )
    floor = np.median(power[len(power) // 2 :])
    below = np.flatnonzero(power[1:] <= FLOOR_RATIO * floor)
    return float(frequencies[1 + below[0]] if below.size else frequencies[-1])
