"""Connections to PyBullet in DIRECT mode: no window, no other process."""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

__all__ = ["connect", "connected"]


def connect() -> Any:
    """Returns a client of a physics server of its own; its methods are PyBullet's functions."""
    with _quiet():  # it greets
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        class QuickClient(BulletClient):
            """Keeps each function once it was asked for; the base wraps it anew every time."""

            def __getattr__(self, name: str) -> Any:
                function = super().__getattr__(name)
                self.__dict__[name] = function
                return function

        return QuickClient(connection_mode=pybullet.DIRECT)


@contextmanager
def connected() -> Iterator[Any]:
    """Connects for the length of a block, in which native code keeps its remarks to itself."""
    with _quiet():
        client = connect()
        try:
            yield client
        finally:
            client.disconnect()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps native code from writing to standard output and standard error inside the block.

    A command's output may be JSON, and Bullet writes to it whatever comes to its mind.
    """
    streams = (sys.stdout, sys.stderr)
    with ExitStack() as stack:
        for stream in streams:
            if stream is not None:
                stream.flush()
        flush = ctypes.CDLL(None).fflush
        flush(None)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, nowhere)
        for descriptor in (1, 2):
            kept = os.dup(descriptor)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, descriptor)
            os.dup2(nowhere, descriptor)
        # Text that waits in native buffers has to go the same way.
        stack.callback(flush, None)
        yield
