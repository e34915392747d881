"""The numbers that the preparation of a recording uses, one validated object per stage.

They are no options for users: :class:`~npdr_ppl.preparation.data_options.DataOptions` has those.
"""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "DENSITY_SURROGATE",
    "DRAW_BUDGET",
    "IMPORTANCE_SAMPLING",
    "INITIAL_STATES",
    "LINEARISATION",
    "LINEAR_REGRESSION",
    "PRIOR_SEARCH",
    "RESIDUAL_SURROGATE",
    "RIDGE",
    "SAMPLING_COORDINATES",
    "SEGMENT_FIT",
    "DensitySurrogateSettings",
    "DrawBudgetSettings",
    "ImportanceSamplingSettings",
    "InitialStateSettings",
    "LinearRegressionSettings",
    "LinearisationSettings",
    "PriorSearchSettings",
    "ResidualSurrogateSettings",
    "RidgeSettings",
    "SamplingCoordinateSettings",
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
class SamplingCoordinateSettings:
    """Coordinates in which posteriors are sampled.

    Attributes:
        tail_coordinate: Absolute reference coordinate of the 1 % and 99 % quantiles.
        widest_ratio: Ratio of a prior's 99 % to its 1 % quantile up to which the logarithm of a
            parameter is taken. A parameter whose prior begins at zero may be zero, where the
            logarithm is infinite.
        num_prior_draws: Number of draws from which the prior's variances are estimated, with an
            error of 5 %.
    """

    tail_coordinate: float = 2.326
    widest_ratio: float = 50.0
    num_prior_draws: int = 1024

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1.0, 5.0, "tail_coordinate")
        check_range(self, 1.0, math.inf, "widest_ratio")
        check_range(self, 100, math.inf, "num_prior_draws")


@dataclass(frozen=True)
class RidgeSettings:
    """Tracing of a posterior's curved ridge.

    Attributes:
        fewest_points: Least number of points at which a ridge is traced. Each point costs one
            simulation of the recording per chord step.
        most_weak: Greatest number of weak coordinates along which a ridge is traced; if there are
            more, the most curved ones, without those along which the posterior is straight.
        points_per_term: Number of points for each term of a quadratic in the weak coordinates.
        first_chord_steps: Chord steps to each point in the first round.
        chord_steps: Chord steps in later rounds, in which a polynomial predicts the points.
        draw_factor: Number of draws for each point; those outside the prior's support are dropped.
        least_found_share: Share of the points that chord steps must find; with fewer, tracing
            ends.
        most_rounds: Greatest number of rounds.
        straight_gain: Log density by which the posterior of a straight coordinate differs at most
            from a normal one at two standard deviations. A normal one with a standard deviation
            5 % greater differs by this.
        close_gain: Tracing can end when the median point gains less log density than this by its
            chord steps. The polynomial is then within the posterior's own width.
        most_degree: Greatest degree of the polynomial.
        points_per_coefficient: Least number of points for each coefficient of the polynomial.
        reach: Spread of the points along the weak coordinates, in standard deviations.
        growth: Tracing continues if a variance grew by more than this factor in a round.
        even_share: Effective share of the traced points that their weights must keep. With less,
            the weights are tempered.
        longest_step: Greatest chord step along a stiff direction, in standard deviations of the
            prior.
        shortest_step: Chord steps to a point end with one that is shorter, in standard deviations
            of the posterior. It would raise the log density by half its square.
        fitted_share: Share of the points to which the polynomial is fitted, those closest to the
            recording. Chord steps need not converge everywhere.
        centre_steps: Parts of a Newton step from the closest fit to the most likely point that are
            tried; each costs one simulation of the recording.
        most_centre_steps: Greatest number of these steps.
        centre_gain: Gain in log density below which they end.
    """

    fewest_points: int = 96
    most_weak: int = 6
    points_per_term: int = 6
    first_chord_steps: int = 5
    chord_steps: int = 3
    draw_factor: int = 20
    least_found_share: float = 0.3
    most_rounds: int = 8
    straight_gain: float = 0.2
    close_gain: float = 1.0
    most_degree: int = 6
    points_per_coefficient: int = 3
    reach: float = 2.0
    growth: float = 1.3
    even_share: float = 0.1
    longest_step: float = 1.0
    shortest_step: float = 0.1
    fitted_share: float = 0.75
    centre_steps: tuple[float, ...] = (1.0, 0.5, 0.25)
    most_centre_steps: int = 8
    centre_gain: float = 0.1

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 10_000, "fewest_points", "points_per_term", "draw_factor")
        check_range(self, 1, 100, "most_weak")
        check_range(self, 1, 100, "first_chord_steps", "chord_steps", "most_rounds")
        check_range(self, 1, 20, "most_degree", "points_per_coefficient")
        check_range(self, 0.0, 1.0, "least_found_share", "even_share", "fitted_share")
        check_range(self, 0.0, 100.0, "straight_gain", "close_gain", "reach")
        check_range(self, 0.0, 100.0, "longest_step", "shortest_step")
        check_range(self, 1.0, 100.0, "growth")
        check_range(self, 0.0, 1.0, "centre_steps")
        check_range(self, 1, 100, "most_centre_steps")
        check_range(self, 0.0, 10.0, "centre_gain")


@dataclass(frozen=True)
class ImportanceSamplingSettings:
    """Adaptive importance sampling of a posterior.

    Attributes:
        draws_per_iteration: Number of draws in each iteration; each is one simulation of the
            recording.
        most_iterations: Greatest number of iterations.
        iterations_to_adapt: Number of iterations after which sampling ends if fewer draws are
            effective than there are parameters: too few to tell a proposal's covariance.
        reliable_k: Greatest Pareto shape k̂ of the weights with which estimates are reliable
            (Vehtari et al. 2024).
        enough_effective: Effective sample size at which sampling ends. The ends of a 90 % interval
            are then known to a tenth of a standard deviation.
        num_walkers: Number of draws that move as an ensemble along a ridge.
        sweeps: Number of moves of each; a surrogate leads most of them. On one Furuta pendulum
            (seed 1075 of ``benchmarks/discovery.py``), standard deviations after 8 were 2 %
            smaller than after 60.
        sweeps_alone: Number of moves of each if there is no surrogate.
        sweeps_between_draws: Moves between draws that are kept, in the second half.
        least_effective: Effective sample size below which the draws do not represent the
            posterior.
        draws_of_given: Number of draws of each density that is given as a first proposal.
        effective_per_parameter: Effective draws per parameter that are needed to estimate a
            proposal's covariance.
        num_kernels: Number of components of a kernel density estimate that serves as a proposal.
        tails: Weights of a proposal's components, and factors of their covariances. The mixture
            has heavier tails than a normal posterior, so that no weight becomes huge.
    """

    draws_per_iteration: int = 512
    most_iterations: int = 16
    iterations_to_adapt: int = 8
    reliable_k: float = 0.7
    enough_effective: float = 200.0
    num_walkers: int = 256
    sweeps: int = 8
    sweeps_alone: int = 30
    sweeps_between_draws: int = 2
    least_effective: float = 100.0
    draws_of_given: int = 128
    effective_per_parameter: float = 8.0
    num_kernels: int = 64
    tails: tuple[tuple[float, float], ...] = ((0.6, 1.0), (0.3, 3.0), (0.1, 10.0))

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "draws_per_iteration", "most_iterations", "num_kernels")
        check_range(self, 1, math.inf, "iterations_to_adapt")
        check_range(self, 1, math.inf, "sweeps", "sweeps_alone", "sweeps_between_draws")
        check_range(self, 4, math.inf, "num_walkers")
        check_range(self, 1, math.inf, "enough_effective", "least_effective", "draws_of_given")
        check_range(self, 0.0, 1.0, "reliable_k")
        check_range(self, 1.0, math.inf, "effective_per_parameter")
        check_range(self, 0.0, math.inf, "tails")


@dataclass(frozen=True)
class ResidualSurrogateSettings:
    """Polynomials in place of the residuals.

    Attributes:
        fewest_first: Least number of simulations before the first fit.
        most_first: Greatest number; a recording of more parameters is sampled without polynomials.
        most_bytes: Most memory for the residuals to which polynomials are fitted.
        draw_factor: Number of draws for each first simulation; those outside the prior's support
            are dropped.
        points_per_term: Polynomials are fitted to the points with the smallest residuals: at least
            to this many for each term of a quadratic, to half of all points, and to all that are
            near.
        near: Difference of the log likelihood from the greatest up to which points are near, for
            each parameter. For draws of a normal density, it is a half on average.
        most_degree: Greatest degree of the polynomials.
        penalties: Penalties of squared coefficients, per point, of which the one with the smallest
            leave-one-out error is taken.
        least_penalty: Penalty in the information about the coefficients, which keeps it regular.
        inside_share: Quantile of the leverages of a fit's points that is the unit of reaches.
        first_reach: Greatest leverage of the first draws. With ten, draws under quadratics may be
            1.8 times as far from the middle as most points.
        more_reach: Factor of the reach after polynomials that are right, but keep draws from going
            farther; its inverse after wrong ones.
        outermost: Quantile of the draws' leverages that has to be within half of the reach;
            otherwise the posterior may be wider than the draws.
        tested: Number of draws under the polynomials that are simulated to test them.
        most_fits: Greatest number of fits.
        least_share: Effective share of the tested draws from which the polynomials can be used.
        enough_share: Effective share from which further fits would not pay.
        margin: Factor of the number of draws beyond what the tested ones predict.
        unlikely_share: Quantile of the own draws' log densities, above which a draw of another
            density counts as likely.
        even_share: Effective share of the points at which chains begin.
        num_walkers: Number of chains.
        fewest_sweeps: Number of moves of each at first; it is doubled until chains are mixed.
        most_sweeps: Greatest number of moves of each.
        most_correlated: Correlation of the chains' coordinates after half of the moves with those
            at the end, below which they are mixed. What is left of where they began is about its
            square.
    """

    fewest_first: int = 128
    most_first: int = 2048
    most_bytes: int = 2**30
    draw_factor: int = 20
    points_per_term: float = 1.1
    near: float = 3.0
    most_degree: int = 4
    penalties: tuple[float, ...] = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
    least_penalty: float = 1e-6
    inside_share: float = 0.9
    first_reach: float = 10.0
    more_reach: float = 10.0
    outermost: float = 0.99
    tested: int = 128
    most_fits: int = 8
    least_share: float = 0.2
    enough_share: float = 0.4
    margin: float = 1.1
    unlikely_share: float = 0.1
    even_share: float = 0.1
    num_walkers: int = 256
    fewest_sweeps: int = 200
    most_sweeps: int = 3200
    most_correlated: float = 0.25

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "fewest_first", "most_first", "most_bytes", "draw_factor")
        check_range(self, 1.0, 100.0, "points_per_term", "margin", "first_reach", "more_reach")
        check_range(self, 0.0, math.inf, "near", "penalties", "least_penalty")
        check_range(self, 1, 10, "most_degree")
        check_range(self, 0.0, 1.0, "least_share", "enough_share", "even_share")
        check_range(self, 0.0, 1.0, "unlikely_share", "inside_share", "outermost")
        check_range(self, 0.0, 1.0, "most_correlated")
        check_range(self, 1, math.inf, "tested", "most_fits")
        check_range(self, 4, math.inf, "num_walkers", "fewest_sweeps", "most_sweeps")


@dataclass(frozen=True)
class DensitySurrogateSettings:
    """The polynomial in place of a log density.

    Attributes:
        deepest: How much less log density than the greatest a point may have to be fitted, beyond
            the number of parameters. It leaves out hardly any draw of a normal density.
        most_degree: Greatest degree of the polynomial.
        points_per_coefficient: Least number of points for each coefficient.
        penalties: Penalties of squared coefficients, per point, of which the one with the smallest
            leave-one-out error is taken: with few points, the density is nearly normal.
        largest_error: Greatest error of the polynomial in log density. With this error, half of
            the moves that it leads are accepted.
    """

    deepest: float = 10.0
    most_degree: int = 4
    points_per_coefficient: int = 1
    penalties: tuple[float, ...] = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
    largest_error: float = 1.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, math.inf, "deepest", "largest_error", "penalties")
        check_range(self, 1, 10, "most_degree")
        check_range(self, 1, math.inf, "points_per_coefficient")


@dataclass(frozen=True)
class DrawBudgetSettings:
    """Memory for simulated trajectories.

    Attributes:
        most_bytes: Bytes of trajectories that are kept at once. Statistics make several copies.
        least_draws: Number of draws that are kept of any recording, however long; fewer do not
            have useful quantiles.
        measurements_per_part: Measurements that are simulated at once, 32 MB in double precision.
            Engines and statistics make copies.
    """

    most_bytes: int = 128 * 2**20
    least_draws: int = 20
    measurements_per_part: int = 4_000_000

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "most_bytes", "least_draws", "measurements_per_part")


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
SAMPLING_COORDINATES = SamplingCoordinateSettings()
RIDGE = RidgeSettings()
IMPORTANCE_SAMPLING = ImportanceSamplingSettings()
RESIDUAL_SURROGATE = ResidualSurrogateSettings()
DENSITY_SURROGATE = DensitySurrogateSettings()
DRAW_BUDGET = DrawBudgetSettings()
LINEAR_REGRESSION = LinearRegressionSettings()
