"""One line of the table of the blind benchmark: a figure, its interval, its target."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from discovery_rows import Row
from scipy.stats import beta

__all__ = ["HEADING", "Baselines", "Line", "Rate", "bootstrap"]

HEADING = (
    "| condition | n | figure | 95 % interval | target | met | refit only "
    "| forward selection by BIC | sparse regression |\n|" + "---|" * 9
)
"""Heading of the table."""

DRAWS = 2000
"""Draws of the bootstrap."""


@dataclass(frozen=True)
class Rate:
    """k of n."""

    hits: int
    total: int

    @classmethod
    def of(cls, rows: Iterable[Row], is_hit: Callable[[Row], bool]) -> "Rate":
        """Counts rows."""
        hits = [bool(is_hit(row)) for row in rows]
        return cls(sum(hits), len(hits))

    @property
    def value(self) -> float:
        """The rate, NaN of nothing."""
        return self.hits / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval after Clopper and Pearson."""
        k, n = self.hits, self.total
        low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
        high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
        return low, high


@dataclass(frozen=True)
class Baselines:
    """Results of refitting alone, of BIC forward selection and of sparse regression, as text."""

    refit: str = "–"
    bic: str = "–"
    sparse: str = "–"


@dataclass(frozen=True)
class Line:
    """One line of the table.

    Attributes:
        condition: What was asked.
        total: Number of cases.
        value: The figure.
        interval: Its 95 % interval, ``None`` where there is none.
        lower: Least value that meets the target.
        upper: Greatest value that meets it.
        greatest_end: Greatest upper end of the interval that meets it.
        baselines: Results of the baselines.
        unit: ``"%"`` where the figure is a share, else what stands behind it.
    """

    condition: str
    total: int
    value: float
    interval: tuple[float, float] | None = None
    lower: float = -math.inf
    upper: float = math.inf
    greatest_end: float = math.inf
    baselines: Baselines = Baselines()
    unit: str = "%"

    @property
    def target(self) -> str:
        """The target in words, empty without one."""
        parts = []
        if math.isfinite(self.lower) and math.isfinite(self.upper):
            parts.append(f"{self._shown(self.lower)} to {self._shown(self.upper)}")
        elif math.isfinite(self.lower):
            parts.append(f"≥ {self._shown(self.lower)}")
        elif math.isfinite(self.upper):
            parts.append(f"≤ {self._shown(self.upper)}")
        if math.isfinite(self.greatest_end):
            parts.append(f"upper end ≤ {self._shown(self.greatest_end)}")
        return ", ".join(parts)

    @property
    def verdict(self) -> str:
        """Whether the target is met: ``"yes"`` or ``"no"``, ``", open"`` where n is too small."""
        if not self.total or not self.target:
            return "–"
        is_met = self.lower <= self.value <= self.upper
        if self.interval is None:
            return "yes" if is_met else "no"
        low, high = self.interval
        is_met = is_met and high <= self.greatest_end
        is_sure = (
            (self.lower <= low and high <= self.upper) or high < self.lower or low > self.upper
        )
        return ("yes" if is_met else "no") + ("" if is_sure else ", open")

    def markdown(self) -> str:
        """Returns the line of the table."""
        value = interval = "–"
        if self.total and math.isfinite(self.value):
            value = self._shown(self.value)
            if self.interval is not None:
                interval = " to ".join(self._shown(end) for end in self.interval)
        cells = (
            *(self.condition, str(self.total), value, interval, self.target or "–", self.verdict),
            *(self.baselines.refit, self.baselines.bic, self.baselines.sparse),
        )
        return f"| {' | '.join(cells)} |"

    def _shown(self, value: float) -> str:
        return f"{100.0 * value:.3g} %" if self.unit == "%" else f"{value:.3g}{self.unit}"


def bootstrap(values: Sequence[float], percentile: float) -> tuple[float, float] | None:
    """Returns the 95 % interval of a percentile, ``None`` of fewer than two values."""
    if len(values) < 2:
        return None
    draws = np.random.default_rng(0).choice(np.asarray(values), (DRAWS, len(values)))
    low, high = np.percentile(np.percentile(draws, percentile, axis=1), [2.5, 97.5])
    return float(low), float(high)
