"""Noise of the readings: encoders that count, tachometers that hiss, and what goes wrong there."""

from dataclasses import dataclass, replace

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["Measurement", "noisy"]

# Correlation of coloured noise from one sample to the next: it lasts some five samples.
_COLOUR = 0.8

# Share of samples that are outliers, and how many standard deviations they are off at most.
_OUTLIER_SHARE = 0.01
_OUTLIER_SIZE = 20.0


@dataclass(frozen=True)
class Measurement:
    """How a rig reads its positions and velocities.

    Attributes:
        counts: Size of an encoder count per position channel, in the channel's unit.
        velocity_noise: Standard deviation per velocity channel, in the channel's unit.
        is_coloured: Whether the noise is correlated over some samples, at the same size.
        has_outliers: Whether one reading in a hundred is far off.
    """

    counts: tuple[float, ...]
    velocity_noise: tuple[float, ...]
    is_coloured: bool = False
    has_outliers: bool = False

    def scaled(self, factor: float) -> "Measurement":
        """Returns the same with all noise, and encoder counts, so much larger."""
        return replace(
            self,
            counts=tuple(factor * count for count in self.counts),
            velocity_noise=tuple(factor * sd for sd in self.velocity_noise),
        )


def noisy(values: Array, measurement: Measurement, generator: np.random.Generator) -> Array:
    """Returns readings of noise-free values ``(R, K, channels)``, positions first.

    Positions are in whole counts. Coloured noise of the size of the quantisation error comes
    before the encoder: white noise there would only undo the quantisation.

    Args:
        values: What noise-free sensors report.
        measurement: The noise.
        generator: Source of randomness.
    """
    counts, hiss = np.array(measurement.counts), np.array(measurement.velocity_noise)
    # The standard deviation of a rounding error.
    sizes = np.concatenate((counts / np.sqrt(12.0), hiss))
    white = generator.standard_normal(values.shape)
    noise = _coloured(white) if measurement.is_coloured else white
    num_positions = len(counts)
    if not measurement.is_coloured:
        noise[..., :num_positions] = 0.0
    result = values + sizes * noise
    if measurement.has_outliers:
        is_off = generator.random(values.shape) < _OUTLIER_SHARE
        result = result + np.where(
            is_off, sizes * _OUTLIER_SIZE * generator.uniform(-1.0, 1.0, values.shape), 0.0
        )
    result[..., :num_positions] = np.round(result[..., :num_positions] / counts) * counts
    return result


def _coloured(white: Array) -> Array:
    """Returns first-order autoregressive noise of unit variance along the second axis."""
    result = white.copy()
    fresh = np.sqrt(1.0 - _COLOUR**2)
    for k in range(1, white.shape[1]):
        result[:, k] = _COLOUR * result[:, k - 1] + fresh * white[:, k]
    return result
