"""Options of a pool of workers."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from npdr_ppl.errors import ModelError

__all__ = ["Executor", "WorkerOptions"]

Executor = Literal["loky", "dask", "ray", "threads", "serial"]
"""Where chunks of draws run: in processes of this machine, on a Dask or Ray cluster, in one
process per thread, or in a single process."""


@dataclass(frozen=True)
class WorkerOptions:
    """How simulations are distributed over workers; no option changes their results.

    Attributes:
        executor: Executor that runs chunks of draws.
        num_workers: Number of workers; ``None`` for one per core, or all of a cluster.
        address: Address of a running Dask scheduler or Ray head; ``None`` starts one here.
        chunk_size: Draws that a worker receives at once; ``None`` makes about 16 chunks per
            worker, with at most 32 draws each.
        time_limit: Seconds that one draw may take; after that, its process is killed.
        retries: How often a draw that crashed, hung, raised an error or returned NaN is repeated.
    """

    executor: Executor = "loky"
    num_workers: int | None = None
    address: str | None = None
    chunk_size: int | None = None
    time_limit: float = 60.0
    retries: int = 1

    def __post_init__(self) -> None:
        """Checks every option.

        Raises:
            ModelError: An option is outside its range.
        """
        if self.executor not in get_args(Executor):
            known = ", ".join(get_args(Executor))
            raise ModelError(f"There is no executor {self.executor!r}; known are {known}.")
        if self.address is not None and self.executor not in ("dask", "ray"):
            raise ModelError(
                f"The executor {self.executor!r} has no address; clusters are 'dask' and 'ray'."
            )
        for name in ("num_workers", "chunk_size"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ModelError(f"{name} must be at least 1, got {value}.")
        if self.executor == "serial" and self.num_workers not in (None, 1):
            raise ModelError(f"The executor 'serial' has one worker, got {self.num_workers}.")
        if not (self.time_limit > 0 and math.isfinite(self.time_limit)):
            raise ModelError(f"time_limit is a number of seconds, got {self.time_limit}.")
        if self.retries < 0:
            raise ModelError(f"retries must not be negative, got {self.retries}.")
