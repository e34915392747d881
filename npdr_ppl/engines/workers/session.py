"""`workers`: chooses the workers for simulations inside a block and counts their faults."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from npdr_ppl.engines.workers.faults import Faults
from npdr_ppl.engines.workers.options import Executor, WorkerOptions
from npdr_ppl.engines.workers.pool import Outcome, Pool, Progress
from npdr_ppl.engines.workers.task import Task

__all__ = [
    "Workers",
    "collect_faults",
    "num_local_processes",
    "report_progress",
    "run_on_workers",
    "workers",
]


class Workers:
    """The workers of a block.

    Attributes:
        pool: The pool.
        faults: Faults so far.
        is_used: Whether any simulation has used them.
    """

    def __init__(self, options: WorkerOptions) -> None:
        self.pool = Pool(options)
        self.faults = Faults()
        self.is_used = False


class FaultCollector:
    """Adds up faults.

    Attributes:
        faults: Faults so far.
    """

    def __init__(self) -> None:
        self.faults = Faults()

    def counts(self) -> dict[str, int]:
        """Returns counts by kind; empty if no worker was used."""
        return self.faults.counts() if self.faults.num_draws else {}


_WORKERS: ContextVar[Workers | None] = ContextVar("workers", default=None)
_COLLECTORS: ContextVar[tuple[FaultCollector, ...]] = ContextVar("collectors", default=())
_PROGRESS: ContextVar[Progress | None] = ContextVar("progress", default=None)


@contextmanager
def workers(
    executor: Executor = "loky",
    num_workers: int | None = None,
    *,
    address: str | None = None,
    chunk_size: int | None = None,
    time_limit: float = 60.0,
    retries: int = 1,
) -> Iterator[Workers]:
    """Chooses the workers for simulations inside the block, and stops them at its end.

    Engines that run one simulation at a time use them for every batch. Batched engines need no
    workers, but discovery fits its candidates in parallel in the processes of ``"loky"``. See
    :class:`~npdr_ppl.engines.workers.options.WorkerOptions` for the arguments.

    Raises:
        ModelError: An option is outside its range.

    Example:
        >>> import npdr_ppl as npdr
        >>> with npdr.workers("serial", time_limit=5.0) as used:
        ...     pass  # npdr.infer(model, rollouts), for example
        >>> used.faults.counts()["lost"]
        0
    """
    options = WorkerOptions(executor, num_workers, address, chunk_size, time_limit, retries)
    chosen = Workers(options)
    token = _WORKERS.set(chosen)
    try:
        yield chosen
    finally:
        _WORKERS.reset(token)
        chosen.pool.close()


@contextmanager
def collect_faults() -> Iterator[FaultCollector]:
    """Adds up the faults inside the block."""
    collector = FaultCollector()
    token = _COLLECTORS.set((*_COLLECTORS.get(), collector))
    try:
        yield collector
    finally:
        _COLLECTORS.reset(token)


@contextmanager
def report_progress(progress: Progress) -> Iterator[None]:
    """Lets simulations inside the block report their progress.

    Args:
        progress: Called with the completed fraction of the present call to a simulator.
    """
    token = _PROGRESS.set(progress)
    try:
        yield
    finally:
        _PROGRESS.reset(token)


def num_local_processes() -> int:
    """Returns the number of local processes of the block that can do any work; otherwise one."""
    chosen = _WORKERS.get()
    if chosen is None or chosen.pool.options.executor != "loky":
        return 1
    from joblib import effective_n_jobs

    chosen.is_used = True
    return max(1, effective_n_jobs(chosen.pool.options.num_workers or -1))


def run_on_workers(task: Task, payloads: list, seed: int) -> Outcome:
    """Runs draws on the workers of the block; outside a block, on one worker per core."""
    chosen = _WORKERS.get()
    if chosen is None:
        with Pool() as pool:
            outcome = pool.run(task, payloads, seed=seed, progress=_PROGRESS.get())
    else:
        chosen.is_used = True
        outcome = chosen.pool.run(task, payloads, seed=seed, progress=_PROGRESS.get())
        chosen.faults += outcome.faults
    for collector in _COLLECTORS.get():
        collector.faults += outcome.faults
    return outcome
