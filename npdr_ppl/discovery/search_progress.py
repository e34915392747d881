"""A progress bar for a search of unknown length."""

from collections.abc import Iterator
from contextlib import contextmanager

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.progress import Reporter, Step, reporter

__all__ = ["SearchProgress"]


class SearchProgress:
    """A bar with a search's sentences beside it.

    The bar is full when ``max_effects`` effects were added; most searches end sooner.

    Args:
        search: Settings of the search.
        show: As :func:`~npdr_ppl.progress.reporter` takes it.
    """

    def __init__(self, search: DiscoveryOptions, show: bool | Reporter | None = None) -> None:
        # The original model has two sentences. Each effect has one for each trial, one when it is
        # added, one for the next screening and one for its probability at the end.
        self._total = 2 + search.max_effects * (TRIALS.shortlist + 3)
        self._said = 0
        self._show = show
        self._step: Step | None = None

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Shows the bar inside the block."""
        with reporter(self._show) as bars:
            # The bar of a larger workflow's reporter stays; others end with the block.
            if self._step is None or bars is not self._show:
                self._step = bars.stage("discover")
            yield

    def say(self, sentence: str) -> None:
        """Shows a sentence, and moves the bar on."""
        self._said += 1
        self._to(min(self._said / self._total, 1.0), sentence)

    def finish(self) -> None:
        """Fills the bar."""
        self._to(1.0, "done")

    def _to(self, fraction: float, status: str) -> None:
        if self._step is not None:
            self._step(fraction, status)
