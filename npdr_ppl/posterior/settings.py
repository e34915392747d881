"""The numbers of the checks after inference, one validated object per stage."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = ["ESTIMATOR_CHECK", "EstimatorCheckSettings"]


@dataclass(frozen=True)
class EstimatorCheckSettings:
    """Comparison of a learnt posterior with the simulator, and its correction.

    Attributes:
        num_draws: Number of draws of a learnt posterior that are weighted; each is one simulation
            of the recording.
        least_effective_share: Effective share of these draws with which the learnt posterior is
            kept. With a share of 0.92, one draw in a thousand was eleven standard deviations away
            from the truth, which made the leave-one-out weights of every segment useless.
        agreeing_share: Effective share from which a learnt posterior that is not corrected agrees
            with the simulator. A normal posterior whose mean is off by half a standard deviation
            has 0.78.
        num_chains: Number of disjoint sets of draws in a corrected posterior, which diagnostics
            compare.
        num_kernels: Number of components of a corrected posterior's density in each chain.
        bandwidth: Standard deviation of these components, in the posterior's. They are shrunk
            towards the mean, so that the variance is that of the draws (West 1993).
        points_per_part: Number of points at which a corrected density is computed at once. With
            all components this takes about ten megabytes per parameter.
    """

    num_draws: int = 256
    least_effective_share: float = 0.99
    agreeing_share: float = 0.8
    num_chains: int = 2
    num_kernels: int = 256
    bandwidth: float = 0.2
    points_per_part: int = 2_000

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "num_draws", "num_kernels", "points_per_part")
        check_range(self, 0.0, 1.0, "least_effective_share", "agreeing_share", "bandwidth")
        check_range(self, 2, 100, "num_chains")


ESTIMATOR_CHECK = EstimatorCheckSettings()
