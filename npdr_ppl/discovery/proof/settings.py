"""The numbers of the proof on held-out data, one validated object per stage."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "EXPERIMENT",
    "GAP",
    "INTERVALS",
    "ExperimentSettings",
    "GapSettings",
    "IntervalSettings",
]


@dataclass(frozen=True)
class GapSettings:
    """The gap between simulation and held-out measurements.

    Attributes:
        num_draws: Number of posterior predictive trajectories.
        level: Probability of the predictive interval whose coverage is reported.
        excess: Ratio of two errors above which they differ. On the tuning seeds of the simulated
            rigs, the error of the true model is at most 1.13 times the noise floor.
        mostly_closed: Least share of the gap that must be closed for an effect to be named.
    """

    num_draws: int = 40
    level: float = 0.9
    excess: float = 1.2
    mostly_closed: float = 0.5

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "num_draws")
        check_range(self, 0.0, 1.0, "level", "mostly_closed")
        check_range(self, 1.0, 100.0, "excess")


@dataclass(frozen=True)
class ExperimentSettings:
    """The experiment that separates alternatives.

    Attributes:
        seconds: Length of the experiment in seconds.
        safe_share: Amplitude as a share of the recording's greatest command, so that no command is
            larger than one that the device has already had.
        useful_separation: Separation, in standard deviations of the measurements, from which an
            experiment is useful.
        most_causes: Greatest number of surviving causes, the likeliest, that are kept for planning
            the next recording. The number of pairs, and the time of planning, grows with its
            square.
        least_probability: Probability from which a cause survives. An effect is named from a
            probability of 0.9, so ten causes of 0.01 together could prevent it.
        power_in_band: Share of a command's power below its bandwidth.
    """

    seconds: float = 4.0
    safe_share: float = 1.0
    useful_separation: float = 5.0
    most_causes: int = 4
    least_probability: float = 0.01
    power_in_band: float = 0.99

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.1, 1000.0, "seconds")
        check_range(self, 0.0, 1.0, "safe_share", "least_probability", "power_in_band")
        check_range(self, 1, 100, "most_causes")
        check_range(self, 0.0, 100.0, "useful_separation")


@dataclass(frozen=True)
class IntervalSettings:
    """Intervals of the parameters.

    Attributes:
        copies: Number of draws that replace each draw before an interval is computed. The shortest
            interval of draws that are not smoothed would be where they happen to be dense.
        bandwidth: Spread of these draws, in standard deviations of the posterior.
        mass: Probability of the interval of highest density.
        rough_iterations: Greatest number of proposals for draws of a model that lacks effects,
            whose weights need not be reliable because the model is wrong.
        quick_draws: Number of draws of Laplace's approximation, where no time may be taken.
    """

    copies: int = 16
    bandwidth: float = 0.3
    mass: float = 0.94
    rough_iterations: int = 2
    quick_draws: int = 1024

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 1000, "copies", "rough_iterations")
        check_range(self, 1, math.inf, "quick_draws")
        check_range(self, 0.0, 1.0, "bandwidth", "mass")


EXPERIMENT = ExperimentSettings()
GAP = GapSettings()
INTERVALS = IntervalSettings()
