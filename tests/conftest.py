import gc
import os

import pytest
import torch
from hypothesis import settings

from npdr_ppl.engines import compilation

# A worker per core: torch's own threads would only get in each other's way.
torch.set_num_threads(int(os.environ.get("NPDR_NUM_THREADS", "1")))

# Nor would processes that a command starts on its own, one per core.
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")

# The same examples every time, so that a run says something about the change under test;
# NPDR_EXPLORE=1 looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("explore", max_examples=2_000)
settings.load_profile("explore" if os.environ.get("NPDR_EXPLORE") else "repeatable")


@pytest.fixture(scope="module", autouse=True)
def spared_collections():
    """Takes what is there to stay, libraries and kernels, out of garbage collections.

    A process that has run hundreds of tests holds millions of objects, and code that frees
    memory on purpose would look through all of them every time.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def short_kernels(monkeypatch):
    """Compiles loops of two time steps, however long they are to run."""
    monkeypatch.setattr(compilation, "_STEPS_PER_CALL", (2,))
    compilation._compile.cache_clear()
    yield
    compilation._compile.cache_clear()
