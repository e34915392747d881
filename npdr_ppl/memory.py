"""Measures the memory that a block of code uses, and releases freed memory."""

import ctypes
import gc
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["MemoryUse", "release_freed_memory", "sampled_memory"]

INTERVAL = 0.02
"""Time between two samples of the memory, in s."""

STATM = Path("/proc/self/statm")
"""File in which Linux reports a process's size in pages; the second number is resident memory."""


class MemoryUse:
    """The largest measured increase of resident memory.

    Attributes:
        peak: Increase over the start in MiB; ``None`` if the system does not report it.
    """

    def __init__(self) -> None:
        self.peak: float | None = None


@contextmanager
def sampled_memory() -> Iterator[MemoryUse]:
    """Samples the process's resident memory inside the block, in a thread.

    The result is the increase over the start, because a process's own peak value cannot be reset.
    Memory that earlier code freed is first returned to the system if the C library can do so;
    otherwise its reuse would not be measured. Libraries loaded at first use count for the block
    that uses them first.
    """
    gc.collect()
    release_freed_memory()
    use = MemoryUse()
    before = _resident()
    if before is None:
        yield use
        return
    use.peak = 0.0
    done = threading.Event()

    def sample() -> None:
        while not done.wait(INTERVAL):
            use.peak = max(use.peak or 0.0, (_resident() or before) - before)

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield use
    finally:
        use.peak = max(use.peak or 0.0, (_resident() or before) - before)
        done.set()
        thread.join()


def release_freed_memory() -> None:
    """Returns freed memory to the operating system; does nothing without glibc.

    Otherwise glibc keeps freed blocks that are too small for the next large array, and the process
    grows.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _resident() -> float | None:
    """Returns the resident memory in MiB, ``None`` if it is not known."""
    try:
        pages = int(STATM.read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
