"""The numbers of the screening, one validated object per stage."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "ALARM",
    "ENCODER",
    "GENERIC_LAWS",
    "LATENT_FORCE",
    "MOMENT_TEST",
    "PERMUTATION_TEST",
    "REPETITION",
    "SENSITIVITY",
    "AlarmSettings",
    "EncoderSettings",
    "GenericLawSettings",
    "LatentForceSettings",
    "MomentTestSettings",
    "PermutationTestSettings",
    "RepetitionSettings",
    "SensitivitySettings",
]


@dataclass(frozen=True)
class AlarmSettings:
    """The test of whether anything is missing. Its false-alarm rate is divided among four tests.

    Attributes:
        catalogue_share: Share for the candidates of the catalogue.
        law_share: Share for generic laws.
        ringing_share: Share for ringing.
        moment_share: Share for forces at some moments.
    """

    catalogue_share: float = 0.6
    law_share: float = 0.2
    ringing_share: float = 0.1
    moment_share: float = 0.1

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self, 0.0, 1.0, "catalogue_share", "law_share", "ringing_share", "moment_share"
        )


@dataclass(frozen=True)
class EncoderSettings:
    """The resolution of an encoder, found from its measurements.

    Attributes:
        least_resolution: Smallest step that is considered, relative to the largest measurement.
            Single precision itself has steps of 6e-8.
        multiple_tolerance: Greatest distance of a measurement from a whole multiple, as a fraction
            of the resolution. Measurements written as decimals are not exact multiples.
    """

    least_resolution: float = 5e-7
    multiple_tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 0.5, "least_resolution", "multiple_tolerance")


@dataclass(frozen=True)
class GenericLawSettings:
    """Laws that represent effects outside the catalogue.

    Attributes:
        sign_width: Width over which a sign changes, as a fraction of the channel's spread.
        num_frequencies: Number of frequencies tried for a wave in time, spaced by half the
            resolution of the longest rollout.
        num_ripples: Number of wave numbers tried for a ripple, spaced by half the resolution of a
            position's range.
        fewest_per_turn: Least number of ripples per turn that cogging may have. The smallest
            motors have six: two poles and three slots.
        most_per_turn: The greatest number. 12 slots and 14 poles have 84. Cogging behind a gear
            has more; a search finds it only if its order is given.
        num_roundings: Number of steps tried to which a command may be rounded. The finest is about
            a 5000th of the greatest command: 0.6 mrad if that is half a turn.
        num_finer_roundings: Number of steps tried about the strongest one. On the one-joint arms
            of ``benchmarks/servo_laws.py`` (seeds 1000 to 1002 and 1010), the best of 400 is
            within 1e-4 of the hidden step, relatively, from where a fit ends in the right minimum.
        num_ringing_frequencies: Number of ringing frequencies tried, evenly spaced in their
            logarithm.
        lowest_ringing_frequency: Lowest ringing frequency, in periods per time step; the highest
            is half a period.
        ringing_damping: Damping ratio of the ringing.
    """

    sign_width: float = 0.1
    num_frequencies: int = 120
    num_ripples: int = 40
    fewest_per_turn: int = 6
    most_per_turn: int = 84
    num_roundings: int = 20_000
    num_finer_roundings: int = 400
    num_ringing_frequencies: int = 30
    lowest_ringing_frequency: float = 0.02
    ringing_damping: float = 0.1

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "sign_width", "lowest_ringing_frequency", "ringing_damping")
        check_range(self, 1, 10_000, "num_frequencies", "num_ripples")
        check_range(self, 1, 100_000, "num_roundings", "num_finer_roundings")
        check_range(self, 1, 10_000, "fewest_per_turn", "most_per_turn", "num_ringing_frequencies")


@dataclass(frozen=True)
class LatentForceSettings:
    """Pulses of force by which a missing force is found.

    Attributes:
        num_pulses: Number of pulses per segment and joint.
        pulse_height: Height of a pulse, as a fraction of the port's rated force. It is small,
            because the response is a derivative.
        largest_difference: Difference of a channel from a joint's position, relative to the
            spread of the position, from which the channel measures something else.
    """

    num_pulses: int = 10
    pulse_height: float = 1e-3
    largest_difference: float = 0.5

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 1000, "num_pulses")
        check_range(self, 0.0, 1.0, "pulse_height", "largest_difference")


@dataclass(frozen=True)
class MomentTestSettings:
    """The test for forces that act in a few segments.

    Attributes:
        num_directions: Number of directions in which a force may act in one segment: those that
            change the measurements most.
        most_segments: Greatest number k of segments that are tested together.
    """

    num_directions: int = 3
    most_segments: int = 20

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, 1000, "num_directions", "most_segments")


@dataclass(frozen=True)
class PermutationTestSettings:
    """Permutation tests.

    Attributes:
        num_permutations: Number of permutations; a p-value is at least one divided by it.
        least_blocks: Neighbouring segments are joined in pairs as long as this many pairs remain.
        most_blocks: In long recordings more neighbours are joined, until at most this many blocks
            remain. More would not improve the test, and its time grows with the cube of their
            number.
        numbers_per_part: Most numbers in one batch of candidates, counted in their changes and in
            their statistics of all permutations; a batch has at least one candidate. With their
            tables they fit into a processor's caches.
        batches_per_release: Number of batches after which freed memory is returned to the system.
            Batches differ in size, so that freed blocks are seldom reused.
        most_in_span: Greatest number of elements of a basis of the changes that forces can cause,
            where measurements are at least twice as many.
        lost_in_span: Greatest part of a change that may lie outside the basis, as a share of it.
    """

    num_permutations: int = 2000
    least_blocks: int = 24
    most_blocks: int = 100
    numbers_per_part: int = 1_000_000
    batches_per_release: int = 25
    most_in_span: int = 256
    lost_in_span: float = 1e-4

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "lost_in_span")
        check_range(
            self,
            1,
            math.inf,
            "most_in_span",
            "num_permutations",
            "least_blocks",
            "most_blocks",
            "numbers_per_part",
            "batches_per_release",
        )


@dataclass(frozen=True)
class RepetitionSettings:
    """Detection of periodic motions and commands.

    Attributes:
        periodic_change: A motion is periodic if its change after one period is below this fraction
            of its change between unrelated times.
        departed_change: Change, as the same fraction, above which a motion has left its initial
            state, so that a period can end.
        most_points: Points of a rollout in the coarse search for a period; the best period is then
            refined.
        largest_phase_error: Phase error, in turns, that a synchronous wave stays below at the end
            of a rollout.
    """

    periodic_change: float = 0.1
    departed_change: float = 0.5
    most_points: int = 1_000
    largest_phase_error: float = 0.25

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "periodic_change", "departed_change", "largest_phase_error")
        check_range(self, 10, math.inf, "most_points")


@dataclass(frozen=True)
class GroupSettings:
    """The same law at several joints.

    Attributes:
        fewest: Least number of joints. Two are found as a pair.
        least_evidence: Least gain of a member in log density, given the others: what makes it
            e⁶ = 400 times as likely as not, so that it outweighs the number of joints and its own
            prior.
    """

    fewest: int = 3
    least_evidence: float = 6.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 2, 1000, "fewest")
        check_range(self, 0.0, 1000.0, "least_evidence")


@dataclass(frozen=True)
class SensitivitySettings:
    """Changes of a simulation by candidate effects.

    Attributes:
        resonance_ratio: Ratio between neighbouring sizes that are tried of a resonance. A lightly
            damped resonance is a tenth wide.
        sizes: Sizes of an effect that is not smooth, as multiples of its probe.
        resonant_sizes: Sizes of a resonance, as multiples of its probe: up to about twice its
            size, with ``resonance_ratio`` between neighbours.
        resonance_stride: Every how many of them is tried first.
        alike: Cosine of the changes by two sizes from which those between them are not tried. The
            linear gain of a size between them is then known to 3 %.
        least_difference: Squared distance of two changes, and difference of their scores, below
            which nothing between them is tried. Noise of unit variance exceeds both if they are
            below one.
        first_limit: First value tried for a limit of commands, as a fraction of the largest
            command.
        limit_quantiles: Quantiles of its prior at which a limit is tried if the recorded commands
            do not tell what it would cut off.
        rounding_errors: A change below this many rounding errors of the largest measurement is
            treated as zero. Effects without influence leave such errors: an encoder's bias, where
            no force depends on its position.
        smooth_size: Size of a smooth effect, as a multiple of its probe: small enough for a linear
            change.
        shape_quantiles: Quantiles of the priors at which shape parameters are tried. The first
            stands for the parameters that are not varied; they have their nominal values.
        most_shapes: Greatest number of shapes tried for one effect.
        segments_per_part: Segments simulated together: the states of more exceed a processor's
            cache.
    """

    resonance_ratio: float = 1.1
    sizes: tuple[float, ...] = (1.0, 0.25)
    resonant_sizes: tuple[float, ...] = tuple(0.05 * 1.1**k for k in range(40))
    resonance_stride: int = 4
    alike: float = 0.95
    least_difference: float = 1.0
    first_limit: float = 0.7
    limit_quantiles: tuple[float, ...] = (0.95, 0.75, 0.5, 0.25, 0.05)
    rounding_errors: float = 100.0
    smooth_size: float = 0.05
    shape_quantiles: tuple[float, ...] = (0.5, 0.15, 0.85)
    most_shapes: int = 7
    segments_per_part: int = 10_000

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self,
            0.0,
            10.0,
            "resonance_ratio",
            "sizes",
            "resonant_sizes",
            "first_limit",
            "smooth_size",
        )
        check_range(self, 1.0, math.inf, "rounding_errors")
        check_range(self, 0.0, 1.0, "shape_quantiles", "limit_quantiles")
        check_range(self, 1, math.inf, "most_shapes", "segments_per_part", "resonance_stride")
        check_range(self, 0.0, 1.0, "alike")
        check_range(self, 0.0, 100.0, "least_difference")


ALARM = AlarmSettings()
ENCODER = EncoderSettings()
GENERIC_LAWS = GenericLawSettings()
GROUPS = GroupSettings()
LATENT_FORCE = LatentForceSettings()
MOMENT_TEST = MomentTestSettings()
PERMUTATION_TEST = PermutationTestSettings()
REPETITION = RepetitionSettings()
SENSITIVITY = SensitivitySettings()
