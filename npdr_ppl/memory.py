"""Measures the memory that a block of code takes, and releases freed memory."""

import ctypes
import gc
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["MemoryUse", "release_freed_memory", "sampled_memory"]

INTERVAL = 0.02
"""Seconds between two samples."""

STATM = Path("/proc/self/statm")
"""Where Linux tells a process its size in pages; the second number is what is resident."""


class MemoryUse:
    """The greatest increase of resident memory that was seen.

    Attributes:
        peak: In MiB, over what was resident at the start; ``None`` where the system does not say.
    """

    def __init__(self) -> None:
        self.peak: float | None = None


@contextmanager
def sampled_memory() -> Iterator[MemoryUse]:
    """Samples the process's resident memory inside the block, by a thread.

    The increase over the start is reported, since a process's own high-water mark cannot be
    reset. What earlier work left to the allocator would be used again unseen, and is first given
    back to the system where the C library can; libraries loaded at first use still count for
    whoever uses them first.
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
    """Returns freed memory to the operating system; does nothing where there is no glibc.

    Otherwise glibc keeps freed blocks that are too small for the next large array, and the process
    grows.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _resident() -> float | None:
    """Returns the resident memory in MiB, ``None`` where it is not known."""
    try:
        pages = int(STATM.read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
