"""A progress bar for a search of unknown length."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.progress import Reporter, reporter

__all__ = ["sentences"]


@contextmanager
def sentences(
    options: DiscoveryOptions, show: bool | Reporter | None = None
) -> Iterator[Callable[[str], None]]:
    """Shows a search's sentences beside a bar, and yields the function that takes them.

    The bar is full when ``max_effects`` effects were added; most searches end sooner.

    Args:
        options: Settings of the search.
        show: As :func:`~npdr_ppl.progress.reporter` takes it.
    """
    # The original model has two sentences. Each effect has one for each trial, one when it is
    # added, one for the next screening and one for its probability at the end.
    total = 2 + options.max_effects * (TRIALS.shortlist + 3)
    said = 0
    with reporter(show) as bars:
        step = bars.stage("discover")

        def report(sentence: str) -> None:
            nonlocal said
            said += 1
            step(min(said / total, 1.0), sentence)

        step(0.0, "reading the recording")
        yield report
        step(1.0, "done")
