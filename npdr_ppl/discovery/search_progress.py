"""The progress of a search of unknown length."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from npdr_ppl.progress import Reporter, Step, reporter

__all__ = ["SearchProgress"]

STAGE = "discover"
"""Label of the sentences of a search."""


class SearchProgress(Reporter):
    """Shows a search's sentences, and stages that have a known number of parts.

    How many effects a search will add is not known before, so the time left for all of it cannot
    be computed. It is shown for the stages.

    Args:
        show: As :func:`~npdr_ppl.progress.reporter` takes it.

    Attributes:
        seconds: Time spent, by stage.
    """

    def __init__(self, show: bool | Reporter | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self._show = show
        # The line of a larger workflow is there before and after the blocks.
        self._line = show if isinstance(show, Reporter) else Reporter()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Shows the progress inside the block."""
        before = self._line
        with reporter(self._show) as self._line:
            try:
                yield
            finally:
                self._line = before

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Shows the progress inside the block, and records how long it takes."""
        begin = time.monotonic()
        with self.shown():
            yield
        self.seconds[stage] = time.monotonic() - begin

    def stage(self, label: str, *, may_end_early: bool = False) -> Step:
        """Returns a callback for a stage that ends within the present block."""
        return self._line.stage(label, may_end_early=may_end_early)

    def say(self, sentence: str) -> None:
        """Shows a sentence."""
        self._line.stage(STAGE)(None, sentence)

    def finish(self) -> None:
        """Fills the bar."""
        self._line.stage(STAGE)(1.0, "done")
