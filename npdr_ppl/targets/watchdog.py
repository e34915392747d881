"""A watchdog: stops a device whose control loop hangs."""

import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

__all__ = ["Watchdog"]


class Watchdog:
    """Calls a function from another thread, at most once, if :meth:`feed` is not called in time.

    The first call of :meth:`feed` arms it. It detects a controller or a driver that waits forever,
    but not a dead or suspended process: it does not replace the watchdog in the device.

    Args:
        timeout: Longest permitted time between two calls of :meth:`feed`, in s; detection may
            take 25 % longer.
        bark: Function to call.
    """

    def __init__(self, timeout: float, bark: Callable[[], None]) -> None:
        self._timeout = timeout
        self._bark = bark
        self._fed_at = math.inf
        self._is_done = threading.Event()
        self._has_barked = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    @property
    def has_barked(self) -> bool:
        """Whether the function was called, because the loop was silent for too long."""
        return self._has_barked.is_set()

    def feed(self) -> None:
        """Reports that the loop is running."""
        self._fed_at = time.monotonic()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_done.set()
        # With a timeout: a device whose stop hangs must not block the loop's own clean-up.
        self._thread.join(self._timeout)

    def _watch(self) -> None:
        # Polling costs the loop less time than a wake-up call in each step.
        while not self._is_done.wait(self._timeout / 4.0):
            if time.monotonic() - self._fed_at > self._timeout:
                self._has_barked.set()
                self._bark()
                return
