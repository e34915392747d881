"""Runs draws on workers in chunks and waves, and restarts an executor that broke."""

import hashlib
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import cloudpickle
import numpy as np

from npdr_ppl.engines.workers.executors import ChunkExecutor, open_executor
from npdr_ppl.engines.workers.faults import Faults
from npdr_ppl.engines.workers.options import WorkerOptions
from npdr_ppl.engines.workers.supervisor import Chunk, ChunkResult
from npdr_ppl.engines.workers.task import Draw, Task
from npdr_ppl.errors import NpdrError, SimulationError

__all__ = ["Outcome", "Pool", "Progress"]

_LOGGER = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
"""Called with the completed fraction and a short status."""

CHUNKS_PER_WORKER = 16
"""Default number of chunks per worker: few enough for negligible overhead, and enough for workers
to finish at about the same time."""

MAX_CHUNK_SIZE = 32
"""Greatest default number of draws in a chunk. If a worker fails, its chunk is repeated."""

WAVE = 32
"""Chunks per worker that may be running or waiting for the caller; this limits memory."""

MAX_BREAKDOWNS = 3
"""How often an executor may break in a row, without a result in between."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        values: The result of each draw, in the order of the draws; ``None`` for a lost draw.
        faults: Faults of the run.
    """

    values: list[np.ndarray | None]
    faults: Faults


class Pool:
    """Runs draws of a task on workers.

    A result depends only on its draw and the seed of the run. It does not depend on the number of
    workers, the chunks, the executor or other draws.

    Args:
        options: Workers and their limits.
    """

    def __init__(self, options: WorkerOptions | None = None) -> None:
        self.options = options or WorkerOptions()
        self._executor: ChunkExecutor | None = None

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()

    def close(self) -> None:
        """Stops all processes that this pool started; a cluster at an address keeps running."""
        if self._executor is not None:
            executor, self._executor = self._executor, None
            executor.close()

    def run(
        self,
        task: Task,
        payloads: Iterable[Any],
        *,
        seed: int = 0,
        num_draws: int | None = None,
        progress: Progress | None = None,
    ) -> Outcome:
        """Runs all draws and collects their results.

        Args:
            task: The task to run.
            payloads: Inputs of the draws, taken from the iterable when workers need them.
            seed: Seed of the run.
            num_draws: Number of payloads, if they have no length.
            progress: Called after each chunk.

        Raises:
            SimulationError: The task cannot be loaded or set up, every draw raised an error, or
                the executor broke several times in a row.
            NpdrError: The task itself raised it, because no draw can succeed.
        """
        values: dict[int, np.ndarray | None] = {}
        faults = Faults()
        total = num_draws if num_draws is not None else _length(payloads)
        for result in self.stream(task, payloads, seed=seed, num_draws=total):
            values |= result.values
            faults += result.faults
            if progress is not None:
                progress(len(values) / total if total else 0.0, f"{len(values)} simulations")
        if faults:
            _LOGGER.warning("%s", faults)
        if faults.raised and set(faults.raised) == set(values):
            raise SimulationError(f"Every simulation raised an error, e.g. {faults.example}.")
        return Outcome([values[index] for index in range(len(values))], faults)

    def stream(
        self, task: Task, payloads: Iterable[Any], *, seed: int = 0, num_draws: int | None = None
    ) -> Iterator[ChunkResult]:
        """Yields results chunk by chunk, as they arrive; see :meth:`run`.

        For any number of draws, at most one wave of chunks is running or waits for the caller.
        """
        executor = self._opened()
        pickled = cloudpickle.dumps(task)
        digest = hashlib.sha256(pickled).hexdigest()
        draws = (Draw(index, payload, seed) for index, payload in enumerate(payloads))
        size = self.options.chunk_size or _chunk_size(num_draws, executor.num_workers)
        limits = self.options.time_limit, self.options.retries
        path = tuple(sys.path)
        chunks = (
            Chunk(pickled, digest, path, part, *limits)
            for part in iter(lambda: tuple(islice(draws, size)), ())
        )
        while wave := list(islice(chunks, WAVE * executor.num_workers)):
            yield from self._run_wave(wave)

    def _run_wave(self, wave: list[Chunk]) -> Iterator[ChunkResult]:
        """Runs chunks, and repeats those that were not done when an executor broke."""
        left = {chunk.draws[0].index: chunk for chunk in wave}
        num_breakdowns = 0
        while left:
            try:
                for result in self._opened().run(list(left.values())):
                    if result.error is not None:
                        raise result.error
                    del left[min(result.values)]
                    num_breakdowns = 0
                    yield result
            except Exception as error:
                if isinstance(error, NpdrError):
                    raise
                # A worker's supervisor died, e.g. because memory ran out. The executor may not
                # recover, so a new one runs the remaining chunks.
                num_breakdowns += 1
                self.close()
                if num_breakdowns >= MAX_BREAKDOWNS:
                    raise SimulationError(
                        f"The executor {self.options.executor!r} broke {num_breakdowns} times in "
                        f"a row: {type(error).__name__}: {error}"
                    ) from error
                _LOGGER.warning("Workers broke (%s); starting them again.", type(error).__name__)

    def _opened(self) -> ChunkExecutor:
        if self._executor is None:
            self._executor = open_executor(self.options)
        return self._executor


def _length(payloads: Iterable[Any]) -> int | None:
    return len(payloads) if hasattr(payloads, "__len__") else None  # pyright: ignore


def _chunk_size(num_draws: int | None, num_workers: int) -> int:
    if num_draws is None:
        return MAX_CHUNK_SIZE
    return max(1, min(MAX_CHUNK_SIZE, num_draws // (CHUNKS_PER_WORKER * num_workers)))
