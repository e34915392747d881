"""Seeds: every random stream is derived from one seed and the purpose of the stream."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

__all__ = ["derived_seed", "seeded"]


def derived_seed(seed: int, *purpose: str | int) -> int:
    """Returns a 63-bit seed for one purpose, independent of all other purposes.

    Seeds depend on the purpose and not on the order of use. A resumed run, or a run with another
    number of workers, therefore gets the same random numbers.

    Args:
        seed: The seed of the whole run.
        purpose: Words and counters that name the stream, e.g. ``"round", 3, "proposal"``.
    """
    words = [zlib.crc32(str(word).encode()) for word in purpose]
    state = np.random.SeedSequence([seed & 0xFFFFFFFF, seed >> 32, *words]).generate_state(2)
    return (int(state[0]) << 31) ^ int(state[1])


@contextmanager
def seeded(seed: int, *purpose: str | int) -> Iterator[None]:
    """Seeds torch's global stream inside the block and restores the caller's stream after it.

    Pyro and zuko draw from torch's global stream and take no generator.
    """
    import torch  # takes seconds; many processes only derive seeds

    devices = [torch.cuda.current_device()] if torch.cuda.is_available() else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(derived_seed(seed, *purpose))
        yield
