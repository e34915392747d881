"""Ends worker processes when the process that started them ends, for any reason.

A worker of loky waits for minutes for its next task. After SIGKILL, its parent cannot stop it.
"""

import os
import time
from threading import Thread
from typing import Any

__all__ = ["end_with_parent", "loky_settings"]

CHECK_SECONDS = 0.5
"""Seconds between two looks at the parent: negligible work, and far below the ten seconds after
which no worker may be left."""


def end_with_parent(parent: int) -> None:
    """Ends this process soon after its parent has ended.

    The kernel's parent-death signal is not used, because it also comes when only the thread ends
    that started the process.

    Args:
        parent: Process number of the parent, which may have ended already.
    """
    Thread(target=_watch, args=(parent,), name="npdr-parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(CHECK_SECONDS)
    os._exit(1)  # immediately, because the main thread may be in the middle of a task


def loky_settings() -> dict[str, Any]:
    """Returns joblib's settings for workers of loky that end with this process."""
    return {"backend": "loky", "initializer": end_with_parent, "initargs": (os.getpid(),)}
