"""Options of `npdr` that say where simulations run, shared by the commands that simulate."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from typing import Annotated

import typer

__all__ = [
    "Address",
    "ExecutorName",
    "ExecutorOption",
    "SimulationLimit",
    "WorkersOption",
    "chosen_workers",
]

PANEL = "Workers, for engines that run one simulation at a time"


class ExecutorName(StrEnum):
    """Executor that runs the simulations."""

    LOKY = "loky"
    DASK = "dask"
    RAY = "ray"
    THREADS = "threads"
    SERIAL = "serial"


ExecutorOption = Annotated[
    ExecutorName | None,
    typer.Option("--executor", help="Executor to use; loky by default.", rich_help_panel=PANEL),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers", min=1, help="Worker count; one per core by default.", rich_help_panel=PANEL
    ),
]
Address = Annotated[
    str | None,
    typer.Option("--address", help="Address of a Dask or Ray cluster.", rich_help_panel=PANEL),
]
SimulationLimit = Annotated[
    float | None,
    typer.Option(
        "--simulation-limit",
        help="Seconds that one simulation may take; 60 by default.",
        rich_help_panel=PANEL,
    ),
]


@contextmanager
def chosen_workers(
    executor: ExecutorName | None,
    num_workers: int | None,
    address: str | None,
    simulation_limit: float | None,
) -> Iterator[None]:
    """Runs simulations inside the block on the executor and workers that the options name.

    A model with a batched engine does not use workers. If any of these options was given then, a
    note is printed to standard error at the end.
    """
    from npdr_ppl.engines.workers import workers

    given = executor, num_workers, address, simulation_limit
    is_asked = any(value is not None for value in given)
    chosen = "loky" if executor is None else executor.value
    limit = 60.0 if simulation_limit is None else simulation_limit
    with workers(chosen, num_workers, address=address, time_limit=limit) as used:
        yield
    if is_asked and not used.is_used:
        typer.echo(
            "npdr: note: --executor, --workers, --address and --simulation-limit had no effect, "
            "because the model's engine simulates batches by itself.",
            err=True,
        )
