"""A progress bar for a search whose length no one knows beforehand."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.search.trials import SHORTLIST
from npdr_ppl.progress import Reporter, reporter

__all__ = ["sentences"]


@contextmanager
def sentences(
    options: DiscoveryOptions, show: bool | Reporter | None = None
) -> Iterator[Callable[[str], None]]:
    """Shows a search's sentences beside a bar, and yields what is to be called with them.

    The bar is full when as many effects were added as may be; most searches end sooner.

    Args:
        options: How the search goes.
        show: As :func:`~npdr_ppl.progress.reporter` takes it.
    """
    # Two sentences at the model as it is; in each round the trials, one that is added, one look
    # and, in the end, one probability.
    total = 2 + options.max_effects * (SHORTLIST + 3)
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
