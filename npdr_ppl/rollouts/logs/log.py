"""A log: signals that were recorded at times of their own."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks

__all__ = ["Log", "Signal"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Signal:
    """One number over time, as a log holds it.

    Attributes:
        name: Its name in the log, e.g. ``/joint_states/shoulder_pan/position``.
        time: Time stamps in s, ``(N,)``, in the order of the log. They may repeat or go back.
        values: Values in ``unit``, ``(N,)``, NaN where one is missing.
        unit: Unit that the log states; ``""`` if it states none.
    """

    name: str
    time: Array
    values: Array
    unit: str = ""

    def __post_init__(self) -> None:
        """Checks that there is one time stamp for each value; raises a ``DataError``."""
        if self.time.shape != self.values.shape or self.time.ndim != 1:
            raise DataError(
                f"{rollout_checks.shown(self.name)} has {self.values.shape} values, but "
                f"{self.time.shape} time stamps."
            )


@dataclass(frozen=True, eq=False)
class Log:
    """The signals of one log.

    Attributes:
        source: Name of the file or folder, for messages.
        signals: The signals, in the order of the log; their names differ.
        notes: What the reader guessed or left out, one sentence each; a fault unless it is a
            :class:`~npdr_ppl.rollouts.notes.Remark`.
        episodes: Name of the signal whose every change begins a new episode; ``""`` if the reader
            found none.
    """

    source: str
    signals: tuple[Signal, ...]
    notes: tuple[str, ...] = ()
    episodes: str = ""

    @cached_property
    def by_name(self) -> dict[str, Signal]:
        """The signals by name."""
        return {signal.name: signal for signal in self.signals}
