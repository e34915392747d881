"""What a calibration found: ranks, coverage, p-values, and whether a posterior may be believed."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from npdr_ppl.errors import DataError
from npdr_ppl.posterior.calibration.uniformity import uniformity_p_value

if TYPE_CHECKING:
    from npdr_ppl.arviz_module import Data

__all__ = ["HIGHEST_DENSITY", "TARP", "Calibration", "Coverage"]

HIGHEST_DENSITY = "highest_density"
TARP = "tarp"
LEVELS = (0.5, 0.8, 0.95)


@dataclass(frozen=True)
class Coverage:
    """How often regions of a given posterior probability held the truth.

    Attributes:
        nominal: Posterior probability α of the regions.
        expected: Share of the data sets whose region held the truth.
        low: Lower end of the Clopper–Pearson confidence interval of that share.
        high: Upper end.
    """

    nominal: float
    expected: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """Ranks of true parameters among posterior draws, over simulated data sets.

    If posterior and simulator agree, each rank is uniform on 0 … L, L being the number of draws.
    Three kinds are kept; each sees failures that the others miss.

    Attributes:
        parameters: Names of the P scalar parameters.
        ranks: Draws smaller than the truth, ``(N, P)`` (Talts et al. 2018).
        density_ranks: Draws of greater posterior density than the truth, ``(N,)`` (Hermans et al.
            2022; Deistler et al. 2022).
        distance_ranks: Draws closer to a reference point than the truth, ``(N,)`` (Lemos et al.
            2023).
        num_draws: Posterior draws L for each data set.
        num_failed: Data sets left out because their simulation was not finite.
        is_refit: Whether the whole inference was repeated for every data set.
        seed: Seed of everything random.
    """

    parameters: tuple[str, ...]
    ranks: NDArray[np.int64]
    density_ranks: NDArray[np.int64]
    distance_ranks: NDArray[np.int64]
    num_draws: int
    num_failed: int
    is_refit: bool
    seed: int

    @property
    def num_datasets(self) -> int:
        """Data sets N that were simulated and inferred."""
        return len(self.ranks)

    def ranks_of(self, quantity: str) -> NDArray[np.int64]:
        """Returns the ranks, ``(N,)``, of a parameter, ``"highest_density"`` or ``"tarp"``.

        Raises:
            DataError: There is no such parameter.
        """
        if quantity in self.parameters:
            return self.ranks[:, self.parameters.index(quantity)]
        joint = {HIGHEST_DENSITY: self.density_ranks, TARP: self.distance_ranks}
        if quantity not in joint:
            known = ", ".join([*self.parameters, *joint])
            raise DataError(f"There are no ranks of {quantity!r}; there are those of {known}.")
        return joint[quantity]

    def coverage(
        self,
        levels: Sequence[float] = LEVELS,
        of: str = HIGHEST_DENSITY,
        *,
        confidence: float = 0.95,
    ) -> list[Coverage]:
        """Returns the expected coverage of regions of given posterior probability.

        Args:
            levels: Probabilities α.
            of: ``"highest_density"`` for regions of highest posterior density, ``"tarp"`` for
                balls around random points, or a parameter for its central intervals.
            confidence: Probability of the binomial intervals.
        """
        # Midpoints of the L + 1 cells that a rank can fall in, as a fraction of their range.
        level = (self.ranks_of(of) + 0.5) / (self.num_draws + 1)
        if of in self.parameters:
            level = np.abs(2 * level - 1)
        result = []
        for nominal in levels:
            hits, misses = int((level <= nominal).sum()), int((level > nominal).sum())
            tail = (1 - confidence) / 2
            low = beta.ppf(tail, hits, misses + 1) if hits else 0.0
            high = beta.ppf(1 - tail, hits + 1, misses) if misses else 1.0
            share = hits / (hits + misses)
            result.append(Coverage(float(nominal), share, float(low), float(high)))
        return result

    @cached_property
    def p_values(self) -> dict[str, float]:
        """The p-value of uniformity by parameter, and of ``"highest_density"`` and ``"tarp"``."""
        quantities = (*self.parameters, HIGHEST_DENSITY, TARP)
        return {q: uniformity_p_value(self.ranks_of(q), self.num_draws) for q in quantities}

    @property
    def tarp_deviation(self) -> float:
        """Greatest distance of TARP's expected coverage from its nominal level.

        Its null distribution is that of Kolmogorov's statistic; ``p_values["tarp"]`` comes from a
        test that also sees the tails.
        """
        level = np.sort((self.distance_ranks + 0.5) / (self.num_draws + 1))
        steps = np.arange(len(level) + 1) / len(level)
        return float(max((steps[1:] - level).max(), (level - steps[:-1]).max()))

    def failures(self, alpha: float = 0.01) -> dict[str, float]:
        """Returns the p-values that reject calibration at level alpha over all tests together."""
        limit = alpha / len(self.p_values)  # Bonferroni
        return {quantity: p for quantity, p in self.p_values.items() if p < limit}

    def passes(self, alpha: float = 0.01) -> bool:
        """Returns whether no test rejects; a calibrated posterior fails with probability alpha."""
        return not self.failures(alpha)

    @property
    def summary(self) -> str:
        """One sentence: the verdict at a false-alarm rate of 1 %, and the coverage."""
        shown = ", ".join(f"{c.expected:.0%} at {c.nominal:.0%}" for c in self.coverage())
        kind = "refitted" if self.is_refit else "simulated"
        based = f"over {self.num_datasets} {kind} data sets"
        if self.num_failed:
            based += f" ({self.num_failed} more failed)"
        failures = self.failures()
        if not failures:
            return f"No sign of miscalibration {based}: highest-density coverage is {shown}."
        named = ", ".join(f"{q} (p = {p:.2g})" for q, p in failures.items())
        return f"Miscalibrated {based}: {named}; highest-density coverage is {shown}."

    def to_dict(self) -> dict[str, Any]:
        """Returns figures and ranks as JSON-serialisable values."""
        quantities = (*self.parameters, HIGHEST_DENSITY, TARP)
        return {
            "summary": self.summary,
            "passes": self.passes(),
            "p_values": self.p_values,
            "coverage": {q: [asdict(c) for c in self.coverage(of=q)] for q in quantities},
            "tarp_deviation": self.tarp_deviation,
            "num_datasets": self.num_datasets,
            "num_draws": self.num_draws,
            "num_failed": self.num_failed,
            "is_refit": self.is_refit,
            "seed": self.seed,
            "ranks": {q: self.ranks_of(q).tolist() for q in quantities},
        }

    def to_arviz(self) -> "Data":
        """Returns the ranks as an ArviZ object.

        Group ``prior_sbc`` holds the ranks as fractions of their range, the probability integral
        transforms that ArviZ's ``plot_ecdf_pit`` draws, one chain with a draw per data set; group
        ``ranks`` holds the ranks themselves.
        """
        from npdr_ppl.arviz_module import from_dict

        ranks = {q: self.ranks_of(q)[None] for q in (*self.parameters, HIGHEST_DENSITY, TARP)}
        fractions = {q: (r + 0.5) / (self.num_draws + 1) for q, r in ranks.items()}
        attrs = {
            "inference_library": "npdr_ppl",
            "num_draws": self.num_draws,
            "num_failed": self.num_failed,
        }
        return from_dict({"prior_sbc": fractions, "ranks": ranks}, attrs=attrs)
