"""Numbers of learning that users do not set."""

from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = ["LEARNING"]


@dataclass(frozen=True)
class LearningSettings:
    """How a law is learned.

    Attributes:
        num_parts: Number of equal parts of each segment. A pulse in each of them shows how the
            measurements respond to a force there. By default a segment has at least 20 steps, so
            that a part is a step of a slow recording, and 10 ms of a fast one.
        pulse_height: Height of a pulse, as a fraction of the port's rated value. It is small,
            because the response is a derivative.
        num_folds: Parts of the recording each of which is predicted from the others.
        beam: Formulas of each size that are extended by another term. Terms that nearly replace
            each other come in groups of a few.
        most_terms: Greatest number of terms of a formula. Longer ones are not understood.
        num_waves: Greatest number of half waves in the visited range of a position. Their number
            bounds the memory and the time.
        fewest_waves: Number of half waves that is tried however small the range is.
        most_per_turn: Greatest number of periods per turn that is tried at a joint that turns, as
            for cogging.
        largest_wave_number: Greatest other wave number that is tried, in 1/rad or 1/m, unless
            ``fewest_waves`` needs more: about two periods per radian.
        num_harmonics: Number of harmonics of a wave that are tried together. Five describe wells
            that are a tenth of their distance wide.
        most_laws: Greatest number of laws at different ports.
        num_fitted: Ports whose best formula is fitted by simulation.
        num_shapes: Values of every other shape constant that are tried.
        narrowest_hysteresis: Least width of a hysteresis that is tried, as a multiple of the
            typical displacement in a step. Narrower ones are dry friction.
        asymmetry: Asymmetry of a hysteresis that is tried first, between 0 and 0.5.
        shortest_relaxation: Least time constant of a relaxation that is tried, in steps. Shorter
            ones are damping.
        damping: Damping ratio of a resonance that is tried first, that of a metal gear.
        longest_lag: Longest lag and delay of a command that are tried, in steps. Working control
            loops have shorter ones.
        most_frequencies: Greatest number of frequencies at which a wave in time is looked for.
        num_resonances: Number of time constants of a resonance that are tried. They are a few
            percent apart, as wide as the peak of a resonance with a damping ratio of 0.05.
        num_peaks: Number of the strongest waves and resonances that become terms.
        negligible: Terms are left out that explain less than this share of what all explain.
            With a precise recording, everything that the model simplifies is significant; a
            formula with many small terms says nothing to a mechanic.
        shape_step: First relative step by which a shape constant is varied.
        finest_shape_step: Relative step at which that ends.
        num_drawn_laws: Draws of a law's constants from which its band is computed.
        num_bins: Bins over which a law and the missing force are averaged for a figure.
        num_knots: Knots of a spline.
        prior_spread: Standard deviation of the prior of a coefficient, as a multiple of the
            port's rated value over the root mean square of the term.
    """

    num_parts: int = 20
    pulse_height: float = 1e-3
    num_folds: int = 8
    beam: int = 8
    most_terms: int = 4
    num_waves: int = 60
    fewest_waves: int = 12
    most_per_turn: int = 84
    largest_wave_number: float = 12.0
    num_harmonics: int = 5
    most_laws: int = 3
    num_fitted: int = 3
    num_shapes: int = 6
    narrowest_hysteresis: float = 2.0
    asymmetry: float = 0.3
    shortest_relaxation: float = 3.0
    damping: float = 0.05
    longest_lag: float = 10.0
    most_frequencies: int = 1000
    num_resonances: int = 60
    num_peaks: int = 8
    negligible: float = 0.01
    shape_step: float = 0.16
    finest_shape_step: float = 0.002
    num_drawn_laws: int = 100
    num_bins: int = 16
    num_knots: int = 9
    prior_spread: float = 3.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 1000, "num_parts", "num_folds", "beam", "most_terms")
        check_range(self, 1, 1000, "num_shapes", "num_knots")
        check_range(self, 1, 1000, "fewest_waves", "most_per_turn", "num_harmonics")
        check_range(self, 1, 1000, "num_waves", "most_laws", "num_fitted", "num_drawn_laws")
        check_range(self, 2, 1000, "num_bins")
        check_range(self, 0.0, 1000.0, "pulse_height", "prior_spread", "largest_wave_number")
        check_range(self, 1, 10_000, "most_frequencies", "num_peaks", "num_resonances")
        check_range(self, 0.1, 100.0, "narrowest_hysteresis", "shortest_relaxation")
        check_range(self, 0.5, 100.0, "longest_lag")
        check_range(self, 0.0, 0.45, "asymmetry")
        check_range(self, 1e-3, 0.9, "damping")
        check_range(self, 0.0, 1.0, "negligible")
        check_range(self, 1e-6, 0.5, "shape_step", "finest_shape_step")


LEARNING = LearningSettings()
"""The values that are used."""
