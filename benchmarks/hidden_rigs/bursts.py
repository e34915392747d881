"""Bursts of torque at random times: something knocks against the rig now and then."""

from collections.abc import Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["TorqueBursts"]


class TorqueBursts:
    """Half sines of random sign at random times, others in every rollout; in no catalogue.

    Args:
        parameters: ``force`` (greatest, in the port's unit), ``rate`` (per s), ``duration`` (s).
        num_rollouts: R.
        duration: Seconds of the recording.
        generator: Source of randomness.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        num_rollouts: int,
        duration: float,
        generator: np.random.Generator,
    ) -> None:
        number = max(1, round(parameters["rate"] * duration))
        shape = (num_rollouts, number)
        self._starts = generator.uniform(0.0, duration, shape)
        signs = np.where(generator.random(shape) < 0.5, -1.0, 1.0)
        self._heights = parameters["force"] * signs * generator.uniform(0.5, 1.0, shape)
        self._duration = parameters["duration"]

    def force(self, t: float) -> Array:
        """Returns the force at a time in s, ``(R,)``."""
        phase = (t - self._starts) / self._duration
        is_on = (phase > 0.0) & (phase < 1.0)
        return (np.where(is_on, np.sin(np.pi * phase), 0.0) * self._heights).sum(axis=-1)
