"""Executors, which pass chunks to workers; all but the serial one use joblib."""

import logging
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from tempfile import TemporaryDirectory
from typing import Any

from npdr_ppl.engines.workers.crew import Crew, run_chunk
from npdr_ppl.engines.workers.guard import guarded_cluster
from npdr_ppl.engines.workers.lifetime import loky_settings
from npdr_ppl.engines.workers.options import WorkerOptions
from npdr_ppl.engines.workers.safe_path import safe_path
from npdr_ppl.engines.workers.supervisor import Chunk, ChunkResult
from npdr_ppl.errors import DependencyError, SimulationError

__all__ = ["ChunkExecutor", "open_executor"]

RAY_CLUSTERS = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"

RAY_KILLS_CHILDREN = "RAY_kill_child_processes_on_worker_exit"


class ChunkExecutor(ABC):
    """Runs chunks on workers.

    Attributes:
        num_workers: Number of chunks that run at the same time.
    """

    num_workers: int

    @abstractmethod
    def run(self, chunks: Iterable[Chunk]) -> Iterator[ChunkResult]:
        """Yields results in the order in which they arrive."""

    @abstractmethod
    def close(self) -> None:
        """Stops everything that this executor started, and nothing else."""


class _Serial(ChunkExecutor):
    """One process, supervised by the caller's thread."""

    num_workers = 1

    def __init__(self) -> None:
        self._crew = Crew()

    def run(self, chunks: Iterable[Chunk]) -> Iterator[ChunkResult]:
        return map(self._crew.run, chunks)

    def close(self) -> None:
        self._crew.close()


class _Joblib(ChunkExecutor):
    """One of joblib's backends.

    Args:
        num_workers: Number of workers; ``None`` for all available ones.
        settings: joblib's name of the backend, and the backend's arguments.
        stack: Resources to close after joblib's backend.
        crew: Supervisors if workers are threads of this process.
        is_streaming: Whether the backend can return results while other chunks are running.
    """

    def __init__(
        self,
        num_workers: int | None,
        settings: dict[str, Any],
        stack: ExitStack,
        *,
        crew: Crew | None = None,
        is_streaming: bool = True,
    ) -> None:
        from joblib import Parallel, effective_n_jobs, parallel_config

        # Only joblib's configuration accepts the names of clusters, and it applies to objects that
        # are created inside this block.
        with parallel_config(n_jobs=num_workers or -1, **settings):
            self.num_workers = max(1, effective_n_jobs(num_workers or -1))
            # Chunks are batches already, and small enough to be sent as they are.
            parallel: Any = Parallel(
                return_as="generator_unordered" if is_streaming else "list",
                batch_size=1,  # pyright: ignore[reportArgumentType]
                pre_dispatch="2*n_jobs",
                max_nbytes=None,
            )
        self._crew = crew
        self._parallel = stack.enter_context(parallel)
        self._stack = ExitStack()

    def run(self, chunks: Iterable[Chunk]) -> Iterator[ChunkResult]:
        from joblib import delayed

        function = run_chunk if self._crew is None else self._crew.run
        results = self._parallel(delayed(function)(chunk) for chunk in chunks)
        yield from results

    def keep(self, stack: ExitStack) -> None:
        """Takes over resources that must be closed at the end."""
        self._stack = stack

    def close(self) -> None:
        # This includes processes for which threads are still waiting.
        if self._crew is not None:
            self._crew.close()
        self._stack.close()


def open_executor(options: WorkerOptions) -> ChunkExecutor:
    """Returns the executor that the options specify; the caller must close it.

    Raises:
        DependencyError: Dask or Ray is not installed.
        SimulationError: There is no cluster at the address.
    """
    if options.executor == "serial":
        return _Serial()
    number = options.num_workers
    with ExitStack() as stack:
        stack.enter_context(safe_path())
        if options.executor == "threads":
            executor = _Joblib(number, {"backend": "threading"}, stack, crew=Crew())
        elif options.executor == "dask":
            client = _dask_client(options, stack)
            executor = _Joblib(number, {"backend": "dask", "client": client}, stack)
        elif options.executor == "ray":
            backend = _connect_to_ray(options, stack)
            # Ray's pool cannot stream, so results arrive wave by wave.
            executor = _Joblib(number, {"backend": backend}, stack, is_streaming=False)
        else:
            settings = {**loky_settings(), "inner_max_num_threads": 1}
            executor = _Joblib(number, settings, stack)
        executor.keep(stack.pop_all())
        return executor


def _dask_client(options: WorkerOptions, stack: ExitStack) -> Any:
    """Connects to a Dask cluster, or starts one on this machine."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise _missing("dask") from error
    cluster: Any = options.address
    if cluster is None:
        cluster = stack.enter_context(
            LocalCluster(
                n_workers=options.num_workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.WARNING,
            )
        )
    try:
        return stack.enter_context(Client(cluster, set_as_default=False))
    except (OSError, ValueError, TimeoutError) as error:
        raise _unreachable(options, error) from error


def _connect_to_ray(options: WorkerOptions, stack: ExitStack) -> Any:
    """Connects this process to a Ray cluster, or starts one; returns joblib's backend for it."""
    is_local = options.address is None
    try:
        import ray
        from ray._private import ray_constants
        from ray._private import utils as ray_utils
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError as error:
        raise _missing("ray") from error

    class Backend(RayBackend):
        """Starts no new workers after an interruption; after errors the pool opens a new one."""

        def abort_everything(self, ensure_ready: bool = True) -> None:
            super().abort_everything(ensure_ready=False)

    backend = Backend()
    if ray.is_initialized():  # the caller's own connection
        return backend
    if is_local:
        # On Linux, Ray listens on all interfaces. Its switch for other systems, which its own
        # processes read from the environment, makes it use the loopback interface only.
        stack.enter_context(_set_variable(RAY_CLUSTERS, "0"))
        stack.enter_context(_set_attribute(ray_constants, "ENABLE_RAY_CLUSTER", False))
        # Ray would kill the supervised processes, but not what they have started. They end by
        # themselves when Ray's worker has ended.
        stack.enter_context(_set_variable(RAY_KILLS_CHILDREN, "0"))
        stack.enter_context(guarded_cluster())
    # Ray would put the current folder on the module search path of its workers.
    empty = stack.enter_context(TemporaryDirectory(prefix="npdr-ray-"))
    # Ray would replace the caller's handler of SIGTERM, in Python and once more in C++.
    handler = signal.getsignal(signal.SIGTERM)
    stack.enter_context(_set_attribute(ray_utils, "set_sigterm_handler", lambda handler: None))
    try:
        ray.init(
            address="local" if is_local else options.address,
            runtime_env={"working_dir": empty},
            num_cpus=options.num_workers if is_local else None,
            include_dashboard=False if is_local else None,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise _unreachable(options, error) from error
    finally:
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)
    stack.callback(ray.shutdown)
    return backend


@contextmanager
def _set_variable(name: str, value: str) -> Iterator[None]:
    """Sets an environment variable inside the block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


@contextmanager
def _set_attribute(module: Any, name: str, value: Any) -> Iterator[None]:
    """Sets a module's attribute inside the block."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def _missing(executor: str) -> DependencyError:
    return DependencyError(
        f"The executor {executor!r} needs a package that is not installed: "
        f"pip install 'npdr-ppl[{executor}]'."
    )


def _unreachable(options: WorkerOptions, error: Exception) -> SimulationError:
    where = f" at {options.address}" if options.address else ""
    return SimulationError(f"There is no {options.executor} cluster{where}: {error}")
