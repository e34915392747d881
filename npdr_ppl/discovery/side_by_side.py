"""Independent pieces of a search, in as many processes as there are workers."""

import logging
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import TypeVar, cast

from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator
from npdr_ppl.engines.workers.session import num_local_processes
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.simulator import Simulator

__all__ = ["num_processes", "side_by_side"]

_LOGGER = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")


def num_processes(simulator: Simulator) -> int:
    """Returns how many processes simulate side by side: those of the enclosing ``workers`` block.

    One where there is no such block, and where the simulator itself uses the workers.
    """
    return 1 if isinstance(simulator, PooledSimulator) else num_local_processes()


def side_by_side(
    function: Callable[[Item], Result], items: Sequence[Item], number: int
) -> Iterator[Result]:
    """Yields the function of every item, in their order.

    Args:
        function: What to do; it travels to the processes, with what it refers to.
        items: What to do it to.
        number: Processes.
    """
    done = 0
    if number > 1 and len(items) > 1:
        # Not at the top: joblib takes a quarter of a second to import.
        from joblib import Parallel, delayed

        # A process whose memory has grown is replaced by a fresh one, with no harm to its work.
        # For good: it is a thread of the executor's that warns, whenever that happens.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        parallel = Parallel(number, backend="loky", return_as="generator", max_nbytes=None)
        results = cast(
            Generator[Result, None, None], parallel(delayed(function)(item) for item in items)
        )
        try:
            for result in results:
                yield result
                done += 1
        except NpdrError:
            raise
        except GeneratorExit:
            # Who has seen enough knows that the rest is given up.
            with warnings.catch_warnings(action="ignore", category=UserWarning):
                results.close()
            raise
        except Exception as error:
            # A process was killed, or something cannot travel, such as a handle of an engine.
            _LOGGER.warning("The search goes on in one process: %s", error)
    for item in items[done:]:
        yield function(item)
