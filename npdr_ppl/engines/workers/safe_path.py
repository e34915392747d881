"""Keeps modules of the current folder out of helper processes.

``python -m`` and ``python -c``, with which loky, Dask and Ray start processes, put the current
folder first on the module search path. A file ``json.py`` beside a downloaded recording would
then run. ``PYTHONSAFEPATH`` prevents this in every Python process that inherits it.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

__all__ = ["inherited_environment", "safe_path"]

SAFE_PATH = "PYTHONSAFEPATH"
ADDED = "NPDR_ADDED_SAFE_PATH"
"""Says that the caller did not set ``PYTHONSAFEPATH``, so that a simulator must not inherit it."""


@contextmanager
def safe_path() -> Iterator[None]:
    """Hides the current folder's modules from Python processes started inside the block."""
    if os.environ.get(SAFE_PATH):  # the caller's own, or that of an enclosing block
        yield
        return
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = os.environ[ADDED] = "1"
    try:
        yield
    finally:
        del os.environ[ADDED]
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


def inherited_environment() -> Mapping[str, str]:
    """Returns the environment for processes that simulate: the caller's.

    A simulator may start a Python script, which needs the modules beside it.
    """
    hidden = {ADDED, SAFE_PATH} if ADDED in os.environ else set()
    return {name: value for name, value in os.environ.items() if name not in hidden}
