"""Runs independent parts of a search in parallel processes, one per worker."""

import logging
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import TypeVar, cast

from npdr_ppl.discovery.kept_fits import keeping
from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator
from npdr_ppl.engines.workers.lifetime import loky_settings
from npdr_ppl.engines.workers.safe_path import safe_path
from npdr_ppl.engines.workers.session import num_local_processes
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.simulator import Simulator

__all__ = ["num_processes", "side_by_side"]

_LOGGER = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")


def num_processes(simulator: Simulator) -> int:
    """Returns the number of parallel processes: those of the enclosing ``workers`` block.

    It is one if there is no such block, or if the simulator itself uses the workers or threads.
    """
    has_own = isinstance(simulator, PooledSimulator) or simulator.uses_threads
    return 1 if has_own else num_local_processes()


def side_by_side(
    function: Callable[[Item], Result], items: Sequence[Item], number: int
) -> Iterator[Result]:
    """Yields the function's result for every item, in the items' order.

    Args:
        function: The function; it is sent to the processes, with all that it refers to.
        items: Its arguments.
        number: Number of processes.
    """
    done = 0
    if number > 1 and len(items) > 1:
        # Not at the top: joblib takes a quarter of a second to import.
        from joblib import Parallel, delayed, parallel_config

        # A process whose memory has grown is replaced by a fresh one, and no result is lost. The
        # filter stays, because a thread of the executor may warn at any time.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        with parallel_config(n_jobs=number, **loky_settings()):
            parallel = Parallel(return_as="generator", max_nbytes=None)
        with safe_path():
            calls = (delayed(keeping(function))(item) for item in items)
            results = cast(Generator[Result, None, None], parallel(calls))
        try:
            with safe_path():  # a process may be replaced at any time
                for result in results:
                    yield result
                    done += 1
        except NpdrError:
            raise
        except GeneratorExit:
            # The caller needs no more results and expects that the others are dropped.
            with warnings.catch_warnings(action="ignore", category=UserWarning):
                results.close()
            raise
        except Exception as error:
            # A process was killed, or something cannot be sent, such as a handle of an engine.
            _LOGGER.warning("The search continues in one process: %s", error)
    for item in items[done:]:
        yield function(item)
