"""Fault injection: a task that crashes, hangs and returns NaN on purpose, in native code too."""

import ctypes
import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from npdr_ppl.engines.workers import Draw, Task
from npdr_ppl.engines.workers.faults import Fault
from npdr_ppl.randomness import derived_seed


@dataclass(frozen=True)
class FaultRates:
    """Shares of draws that fail, and how often in a row they do.

    Attributes:
        crash: Share that ends its process.
        hang: Share that never returns.
        nan: Share that returns NaN.
        times: Attempts of a chosen draw that fail: 1 for a fault that a retry cures.
    """

    crash: float = 0.01
    hang: float = 0.01
    nan: float = 0.03
    times: int = 1

    def fault(self, draw: Draw) -> Fault | None:
        """Returns what happens to a draw; depends on its seed, not on who runs it."""
        if draw.attempt >= self.times:
            return None
        u = np.random.default_rng(derived_seed(draw.seed, "fault")).uniform()
        for fault, share in (
            (Fault.CRASHED, self.crash),
            (Fault.HUNG, self.hang),
            (Fault.NAN, self.nan),
        ):
            if u < share:
                return fault
            u -= share
        return None


@dataclass(frozen=True)
class Faulty(Task):
    """A task that fails at given rates, and otherwise does what another task does."""

    task: Task
    rates: FaultRates

    def set_up(self) -> Any:
        return self.task.set_up()

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        fault = self.rates.fault(draw)
        if fault is Fault.CRASHED:
            crash(draw.index)
        if fault is Fault.HUNG:
            hang(draw.index)
        result = self.task.run(workspace, draw)
        return np.full_like(result, np.nan) if fault is Fault.NAN else result


def crash(index: int) -> None:
    """Ends the process: by itself, or by a segmentation fault in native code."""
    if index % 2:
        os._exit(3)
    ctypes.string_at(0)


def hang(index: int) -> None:
    """Never returns: asleep in Python, or in a native call that holds the interpreter's lock."""
    if index % 2:
        while True:
            time.sleep(1.0)
    ctypes.PyDLL(None).pause()
