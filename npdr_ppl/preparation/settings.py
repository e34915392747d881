"""The numbers by which a recording is fitted, one validated object per stage.

Those by which a posterior is drawn are in :mod:`~npdr_ppl.preparation.sampling_settings`. They are
no options for users: :class:`~npdr_ppl.preparation.data_options.DataOptions` has those.
"""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "INITIAL_STATES",
    "LINEARISATION",
    "LINEAR_REGRESSION",
    "PRIOR_SEARCH",
    "SEGMENT_FIT",
    "InitialStateSettings",
    "LinearRegressionSettings",
    "LinearisationSettings",
    "PriorSearchSettings",
    "SegmentFitSettings",
]


@dataclass(frozen=True)
class LinearisationSettings:
    """Finite differences of segments, and the least scale of their residuals.

    Attributes:
        parameter_step: Half the width of finite differences of parameters, in standard deviations
            of the prior. It exceeds the changes that single precision and dry friction hide.
        initial_state_step: Half the width of finite differences of initial states, in standard
            deviations of the smoother's error.
        start_limit: Greatest distance of a fit's first point from the prior's centre, in standard
            deviations. At the ends of a prior's range a parameter hardly changes with its
            reference coordinate.
        relative_scale_floor: Least scale of a channel's residuals, as a share of its largest
            measurement. Files and simulations in single precision hold no more digits. With less
            noise, the initial states of a simulated recording without noise cannot be integrated
            out in double precision.
        absolute_scale_floor: Least scale of the residuals of a channel that is zero throughout,
            in the channel's unit.
        largest_step_error: Error of a log likelihood in corrected coarser steps, two standard
            deviations from the fit, from which a posterior is drawn in the model's own steps. The
            log density itself falls by two there; where it falls by more, proportionally more.
    """

    parameter_step: float = 1e-2
    initial_state_step: float = 0.1
    start_limit: float = 4.5
    relative_scale_floor: float = 1e-6
    absolute_scale_floor: float = 1e-9
    largest_step_error: float = 0.5

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1e-6, 1.0, "parameter_step", "initial_state_step")
        check_range(self, 1.0, 8.0, "start_limit")
        check_range(self, 0.0, 1e-2, "relative_scale_floor", "absolute_scale_floor")
        check_range(self, 0.0, 10.0, "largest_step_error")


@dataclass(frozen=True)
class SegmentFitSettings:
    """Damped Gauss-Newton steps, and restarts from other points.

    A fit begins with rough steps, which use one-sided differences and estimate the scale of each
    channel's residuals again after every step. Precise steps at that scale follow.

    Attributes:
        first_damping: Damping of the first step, relative to the curvature of each parameter and
            of each segment's initial state.
        damping_limits: Smallest and greatest damping.
        near_factors: Multiples of the last successful damping that are tried first.
        far_factors: Multiples that are tried if the near ones gain less than seems possible.
        rough_gain: Rough steps end when no step can reduce the objective by more than this share.
        settled_scale: Rough steps end only when the last step has kept each channel's scale at
            this share of its previous value or more.
        longest_step: Greatest change of a parameter's reference coordinate in one step, in
            standard deviations of the prior; away from an end of a uniform prior, the same share
            of the range as from its middle. Initial states are not limited: on an unstable motion
            they can be wrong by many standard deviations, and each segment has its own damping.
        largest_coordinate: Greatest distance of a fit from the prior's centre, in standard
            deviations. A strength that is much smaller than typical for its half-normal prior has
            a coordinate of −3 or less.
        least_gain: Steps end when no step can reduce the objective, in variances of the
            measurement noise and for independent measurements, by more than this. What a step can
            gain is computed from the derivatives, or tried where the misfit has local minima. The
            default is a quarter of a unit of log evidence. A model that is ten times as likely as
            another has 2.3 units more.
        outlier_misfit: Multiple of the median segment's misfit above which other initial states
            are tried.
        initial_state_restarts: Distances of these initial states, in standard deviations of the
            smoother's error, along each component.
        restart_distances: Distances of restarts from a fit where the misfit has local minima, in
            standard deviations of the fit's normal approximation.
        wide_restart_distances: The same in standard deviations of the prior. The curvature at a
            local minimum says little about the misfit beyond it.
        restart_directions: Number of random directions of restarts, per coordinate that has local
            minima.
        most_restarts: Greatest number of successive restarts.
        most_updates: Greatest number of steps with corrected derivatives of an earlier point.
        least_ratio: Derivatives are corrected only if they need at least this many times as many
            simulations as the trial points of one step.
    """

    first_damping: float = 1e-2
    damping_limits: tuple[float, float] = (1e-8, 1e6)
    near_factors: tuple[float, ...] = (0.1, 1.0, 10.0)
    far_factors: tuple[float, ...] = (1e-4, 1e-2, 1.0, 1e2, 1e4)
    rough_gain: float = 1e-3
    settled_scale: float = 0.95
    longest_step: float = 1.0
    largest_coordinate: float = 5.0
    least_gain: float = 0.5
    outlier_misfit: float = 10.0
    initial_state_restarts: tuple[float, ...] = (1.0, 4.0)
    restart_distances: tuple[float, ...] = (1.0, 3.0, 10.0)
    wide_restart_distances: tuple[float, ...] = (0.03, 0.1, 0.3)
    restart_directions: int = 6
    most_restarts: int = 4
    most_updates: int = 3
    least_ratio: float = 2.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, *self.damping_limits, "first_damping")
        check_range(self, 1e-8, 1e8, "near_factors", "far_factors")
        check_range(self, 0.0, 1.0, "rough_gain", "settled_scale")
        check_range(self, 1e-3, 8.0, "longest_step", "largest_coordinate")
        check_range(self, 0.0, math.inf, "least_gain", "initial_state_restarts")
        check_range(self, 0.0, math.inf, "restart_distances", "wide_restart_distances")
        check_range(self, 1.0, math.inf, "outlier_misfit")
        check_range(self, 0, 100, "restart_directions", "most_restarts", "most_updates")
        check_range(self, 0.0, math.inf, "least_ratio")


@dataclass(frozen=True)
class PriorSearchSettings:
    """The cross-entropy search for the closest fit, over the whole prior.

    Attributes:
        iterations: Number of iterations. Enough to find the basin of the closest fit, not its
            lowest point.
        population: Number of parameter sets in each iteration.
        iterations_before_steps: Number of iterations if Gauss-Newton steps follow.
        most_segments: Greatest number of segments that are simulated, also by the rough fits that
            follow and while priors are widened. In the search on the tuning recordings of
            ``benchmarks/clean_fits.py``, fits end at the same parameters as with all segments.
        negligible_deviation: Standard deviation that is negligible in every unit.
    """

    iterations: int = 6
    population: int = 200
    iterations_before_steps: int = 3
    most_segments: int = 24
    negligible_deviation: float = 1e-9

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "iterations", "iterations_before_steps", "most_segments")
        check_range(self, 10, math.inf, "population")
        check_range(self, 0.0, 1e-3, "negligible_deviation")


@dataclass(frozen=True)
class InitialStateSettings:
    """Estimation of the errors of the segments' initial states.

    Attributes:
        iterations: Number of iterations of expectation maximisation. Components about which the
            measurements say little hardly change.
        factor_limits: Smallest and greatest factor by which the smoother's errors are scaled.
    """

    iterations: int = 30
    factor_limits: tuple[float, float] = (0.2, 10.0)

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 10_000, "iterations")
        check_range(self, 1e-3, 1e3, "factor_limits")


@dataclass(frozen=True)
class LinearRegressionSettings:
    """Linear regression on a model's base parameters.

    Attributes:
        num_prior_draws: Number of prior draws from which the moments of the base parameters are
            computed.
        relative_rank: Least singular value of a direction, relative to the largest. Linear
            relations hold to 1e-12.
    """

    num_prior_draws: int = 4_096
    relative_rank: float = 1e-7

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 100, math.inf, "num_prior_draws")
        check_range(self, 1e-12, 1.0, "relative_rank")


LINEARISATION = LinearisationSettings()
SEGMENT_FIT = SegmentFitSettings()
PRIOR_SEARCH = PriorSearchSettings()
INITIAL_STATES = InitialStateSettings()
LINEAR_REGRESSION = LinearRegressionSettings()
