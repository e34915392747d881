"""Progress bars for long operations; nothing is shown without a terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import TaskID

__all__ = ["Reporter", "Step", "reporter"]

Step = Callable[[float, str], None]
"""Callback that takes the fraction done and a short status."""


class Reporter:
    """Provides one callback per stage of a workflow; this base class reports nothing."""

    def stage(self, label: str) -> Step:
        """Returns a callback for a stage: fraction done and a short status."""
        return lambda fraction, status: None

    def under(self, label: str) -> "Reporter":
        """Returns a reporter that puts a label before the names of its stages."""
        return _Labelled(self, label)


class _Labelled(Reporter):
    def __init__(self, parent: Reporter, label: str) -> None:
        self.parent = parent
        self.label = label

    def stage(self, label: str) -> Step:
        return self.parent.stage(f"{self.label}: {label}")


class _RichReporter(Reporter):
    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self.bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[status]}"),
            console=Console(stderr=True),
        )

    def stage(self, label: str) -> Step:
        # The bar appears with the first step, because a stage may have nothing to do.
        task: TaskID | None = None

        def step(fraction: float, status: str) -> None:
            nonlocal task
            if task is None:
                task = self.bars.add_task(label, total=1.0, status="")
            self.bars.update(task, completed=fraction, status=status)

        return step


@contextmanager
def reporter(show: bool | Reporter | None = None) -> Iterator[Reporter]:
    """Shows progress bars inside the block.

    Args:
        show: Whether to show them; ``None`` shows them if standard error is a terminal. The
            reporter of a larger workflow is used unchanged.
    """
    if isinstance(show, Reporter):
        yield show
        return
    if not (sys.stderr.isatty() if show is None else show):
        yield Reporter()
        return
    rich = _RichReporter()
    with rich.bars:
        yield rich
