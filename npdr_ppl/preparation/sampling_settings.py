"""The numbers by which a posterior is drawn, one validated object per stage.

They are no options for users, as those of :mod:`~npdr_ppl.preparation.settings`.
"""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "DENSITY_SURROGATE",
    "DRAW_BUDGET",
    "IMPORTANCE_SAMPLING",
    "RESIDUAL_SURROGATE",
    "RIDGE",
    "SAMPLING_COORDINATES",
    "DensitySurrogateSettings",
    "DrawBudgetSettings",
    "ImportanceSamplingSettings",
    "ResidualSurrogateSettings",
    "RidgeSettings",
    "SamplingCoordinateSettings",
]


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


SAMPLING_COORDINATES = SamplingCoordinateSettings()
RIDGE = RidgeSettings()
IMPORTANCE_SAMPLING = ImportanceSamplingSettings()
RESIDUAL_SURROGATE = ResidualSurrogateSettings()
DENSITY_SURROGATE = DensitySurrogateSettings()
DRAW_BUDGET = DrawBudgetSettings()
