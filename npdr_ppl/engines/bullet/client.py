"""Connections to PyBullet in DIRECT mode: without a window and without another process."""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

__all__ = ["connect", "connected"]


def connect() -> Any:
    """Returns a client of a new physics server; its methods are PyBullet's functions."""
    with _quiet():  # the import prints a message
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        class QuickClient(BulletClient):
            """Caches each function; the base class wraps it anew at every access."""

            def __getattr__(self, name: str) -> Any:
                function = super().__getattr__(name)
                self.__dict__[name] = function
                return function

        return QuickClient(connection_mode=pybullet.DIRECT)


@contextmanager
def connected() -> Iterator[Any]:
    """Connects for the duration of a block, in which native code prints nothing."""
    with _quiet():
        client = connect()
        try:
            yield client
        finally:
            client.disconnect()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps native code from writing to standard output and standard error inside the block.

    A command's output may be JSON, and messages from Bullet would make it invalid.
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
        # Text that is still in native buffers must be discarded, too.
        stack.callback(flush, None)
        yield
