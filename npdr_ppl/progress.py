"""The progress of long operations: one line on a terminal, elsewhere a line per minute."""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Reporter", "Step", "TimeLeft", "reporter", "words_for"]

Step = Callable[[float | None, str], None]
"""Callback that takes the fraction done, ``None`` if the total is not known, and a short status.

A stage reports 0 when it begins, if that is before its first part is done: the time that its parts
take is counted from the first report."""

BAR_WIDTH = 10
"""Width of the bar in characters. On a terminal of 80, it leaves room for label, status and time,
e.g. ``effect 1``, ``2 of 6 candidates fitted`` and ``at most 3.5 min left in this step``."""


LOG_INTERVAL = 60.0
"""Seconds between two lines where standard error is no terminal."""


class TimeLeft:
    """Estimates how long a piece of work still takes, from the fractions done so far.

    If a fraction f₀ was done at the first report and f at the latest, t − t₀ seconds later, the
    rest takes

        (1 − f) (t − t₀) / (f − f₀)

    seconds from then on at the mean speed. Between reports the estimate counts down, but by no
    more than the mean time between two reports: after that, the next one is overdue, and the
    work is slower than it was.

    Args:
        clock: Returns the time in s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._first: tuple[float, float] | None = None  # fraction and time
        # One tuple, because the thread that draws the line reads it: fraction, time and number of
        # reports after the first.
        self._latest: tuple[float, float, int] | None = None

    def report(self, fraction: float | None) -> None:
        """Takes the fraction done; the count begins anew if it is ``None`` or has decreased."""
        now, latest = self._clock(), self._latest
        if fraction is None:
            self._latest = None
        elif latest is None or fraction < latest[0]:
            self._first, self._latest = (fraction, now), (fraction, now, 0)
        elif fraction > latest[0]:
            self._latest = fraction, now, latest[2] + 1

    @property
    def seconds(self) -> float | None:
        """The estimate in s; ``None`` if it cannot be computed, or if it has run out."""
        first, latest = self._first, self._latest
        if first is None or latest is None or not latest[2]:
            return None
        fraction, at, number = latest
        spent = at - first[1]
        left = (1.0 - fraction) * spent / (fraction - first[0])
        left -= min(self._clock() - at, spent / number)
        return left if left > 0.0 else None


def words_for(seconds: float) -> str:
    """Returns a duration in s, min or h with two digits, e.g. ``"85 s"`` or ``"2.5 min"``.

    More digits would claim an accuracy that an estimate does not have. The least is 1 s.
    """
    if seconds < 100.0:
        return f"{max(seconds, 1.0):.0f} s"
    number, unit = (seconds / 60.0, "min") if seconds < 6000.0 else (seconds / 3600.0, "h")
    return f"{number:.1f} {unit}" if number < 10.0 else f"{number:.0f} {unit}"


class Reporter:
    """Provides one callback per stage of a workflow; this base class reports nothing."""

    def stage(self, label: str, *, may_end_early: bool = False) -> Step:
        """Returns a callback for a stage: fraction done and a short status.

        Args:
            label: Name of the stage.
            may_end_early: Whether the stage may end before its fraction is 1, as training does.
                The time left is then an upper limit.
        """
        return lambda fraction, status: None

    @contextmanager
    def overall(self, label: str) -> Iterator[Step]:
        """Yields a callback for the work inside the block: equal parts that each have stages.

        As soon as one part is done, the time left for all of them is shown, instead of that of
        the present stage. If blocks are nested, it is that of the outermost.

        Args:
            label: Name of all parts together, e.g. ``"all rounds"``.
        """
        yield lambda fraction, status: None

    def under(self, label: str) -> "Reporter":
        """Returns a reporter that puts a label before the names of its stages."""
        return _Labelled(self, label)


class _Labelled(Reporter):
    def __init__(self, parent: Reporter, label: str) -> None:
        self.parent = parent
        self.label = label

    def stage(self, label: str, *, may_end_early: bool = False) -> Step:
        return self.parent.stage(f"{self.label}: {label}", may_end_early=may_end_early)

    @contextmanager
    def overall(self, label: str) -> Iterator[Step]:
        with self.parent.overall(f"{label} of {self.label}") as step:
            yield step


class _TimedReporter(Reporter, ABC):
    """Keeps the time left of the present stage and of the outermost work of equal parts.

    Args:
        clock: Returns the time in s.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._began = clock()
        # The time left, and the words before and after it, of the stage that is shown and of the
        # outermost work of equal parts.
        self._shown: tuple[TimeLeft, str, str] | None = None
        self._overall: tuple[TimeLeft, str, str] | None = None

    @abstractmethod
    def show(self, label: str, fraction: float | None, status: str) -> None:
        """Shows a report of a stage.

        Args:
            label: Name of the stage.
            fraction: The fraction done, ``None`` if the total is not known.
            status: A short status.
        """

    def stage(self, label: str, *, may_end_early: bool = False) -> Step:
        left = TimeLeft(self._clock)
        times = left, "at most" if may_end_early else "about", "in this step"

        def step(fraction: float | None, status: str) -> None:
            left.report(fraction)
            self._shown = times
            self.show(label, fraction, status)

        return step

    @contextmanager
    def overall(self, label: str) -> Iterator[Step]:
        left, outer = TimeLeft(self._clock), self._overall
        self._overall = outer or (left, "about", f"for {label}")
        try:
            yield lambda fraction, status: left.report(fraction)
        finally:
            self._overall = outer

    def time_words(self) -> str:
        """Returns the time left where it is known, and otherwise the time that has passed."""
        for times in (self._overall, self._shown):
            seconds = None if times is None else times[0].seconds
            if times is not None and seconds is not None:
                return f"{times[1]} {words_for(seconds)} left {times[2]}"
        return f"{words_for(self._clock() - self._began)} so far"


class _LineReporter(_TimedReporter):
    """Shows the present stage on one line: label, bar, status and time."""

    def __init__(
        self, console: "Console | None" = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, ProgressColumn
        from rich.table import Column
        from rich.text import Text

        class Words(ProgressColumn):
            """Text that is made at every refresh; where there is no room, its end is left out."""

            def __init__(self, words: Callable[[Any], str], is_kept: bool = False) -> None:
                super().__init__(Column(no_wrap=is_kept, overflow="ellipsis"))
                self.words = words

            def render(self, task: Any) -> Text:
                return Text(self.words(task), no_wrap=True, overflow="ellipsis")

        super().__init__(clock)
        self.bars = Progress(
            Words(lambda task: task.description),
            BarColumn(BAR_WIDTH),
            Words(lambda task: task.fields["status"]),
            Words(lambda task: self.time_words(), is_kept=True),
            console=console or Console(stderr=True),
            transient=True,
        )

    def show(self, label: str, fraction: float | None, status: str) -> None:
        # The line appears with the first step, because a stage may have nothing to do.
        if not self.bars.tasks:
            self.bars.add_task(label, total=1.0, status="")
        (task,) = self.bars.tasks
        task.total = None if fraction is None else 1.0
        done = fraction or 0.0
        self.bars.update(task.id, description=label, completed=done, status=status)


class _LogReporter(_TimedReporter):
    """Writes a line per minute, for a log: label, status and time.

    If a step takes longer than a minute, its last report is written again with the new time.
    """

    def __init__(self, file: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(clock)
        self._file = file
        self._written = self._began
        self._latest = "working"
        self._lock = threading.Lock()

    def show(self, label: str, fraction: float | None, status: str) -> None:
        self._latest = f"{label}: {status}" if status else label
        self.write_if_due()

    def write_if_due(self) -> None:
        """Writes the latest report, if the last line is a minute old."""
        with self._lock:
            now = self._clock()
            if now - self._written < LOG_INTERVAL:
                return
            self._written = now
            when = time.strftime("%H:%M:%S")
            print(f"npdr: {when} {self._latest}, {self.time_words()}", file=self._file, flush=True)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Writes lines inside the block, also if nothing is reported."""
        is_over = threading.Event()

        def watch() -> None:
            while not is_over.wait(LOG_INTERVAL / 10):
                self.write_if_due()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()


@contextmanager
def reporter(show: bool | Reporter | None = None) -> Iterator[Reporter]:
    """Shows a line with the progress inside the block.

    Args:
        show: Whether to show it. ``None`` shows it if standard error is a terminal, and otherwise
            writes a line to it every minute. The reporter of a larger workflow is used unchanged.
    """
    if isinstance(show, Reporter):
        yield show
        return
    if show is None and not sys.stderr.isatty():
        log = _LogReporter(sys.stderr)
        with log.watched():
            yield log
        return
    if show is False:
        yield Reporter()
        return
    line = _LineReporter()
    with line.bars:
        yield line
