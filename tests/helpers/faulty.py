"""Fault injection: tasks that crash, hang and return NaN on purpose.

Crashes are exits and segmentation faults; hangs sleep in Python, sit in a native call that holds
the interpreter's lock, or wait for a program of their own; nothing is mocked.
"""

import ctypes
import os
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
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

    def fault(self, key: int) -> Fault | None:
        """Returns what happens to a draw; depends on the draw, not on who runs it."""
        u = np.random.default_rng(key).uniform()
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
        fault = self.rates.fault(derived_seed(draw.seed, "fault"))
        if draw.attempt >= self.rates.times:
            fault = None
        return fail(fault, draw.index, lambda: self.task.run(workspace, draw))


def crash(number: int) -> None:
    """Ends the process: by itself, or by a segmentation fault in native code."""
    if number % 2:
        os._exit(3)
    ctypes.string_at(0)


PROGRAM = "sleep", "86399"
"""The program for which simulations wait."""


def hang(number: int) -> None:
    """Never returns: asleep, in a native call that holds the interpreter's lock, or waiting."""
    if number % 3 == 0:
        subprocess.run(PROGRAM)
    if number % 3 == 1:
        while True:
            time.sleep(1.0)
    ctypes.PyDLL(None).pause()


def num_programs() -> int:
    """Returns the number of such programs that are running."""
    words = "\0".join(PROGRAM).encode() + b"\0"
    found = 0
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended in the meantime
            found += file.read_bytes() == words
    return found


def fail(fault: Fault | None, number: int, run: Callable[[], np.ndarray]) -> np.ndarray:
    """Runs what may fail, or fails."""
    if fault is Fault.CRASHED:
        crash(number)
    if fault is Fault.HUNG:
        hang(number)
    result = run()
    return np.full_like(result, np.nan) if fault is Fault.NAN else result
