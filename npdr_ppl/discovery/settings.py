"""The numbers of discovery as a whole, one validated object per stage."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "REPAIR",
    "HYPOTHESIS",
    "VERDICT",
    "RepairSettings",
    "HypothesisSettings",
    "VerdictSettings",
]


@dataclass(frozen=True)
class RepairSettings:
    """Remedies for a recording with wrong units, signs or time stamps.

    Attributes:
        large_residual: Residual, relative to the change of a window's measurements, above which
            remedies are tried.
        disregarded_share: Share of the squared change of the measurements that does not count, in
            the windows with the largest residuals. Of a bouncing ball's windows, up to a sixth
            begin at an impact and have a wrong initial state.
        remedy_factor: A remedy is applied if it reduces the residual to less than this fraction.
        most_remedies: Greatest number of remedies of one recording.
        most_segments: Greatest number of segments along which remedies are tried. A unit, a sign
            or a clock is wrong in the whole recording. With the default length they last 40 s.
        first_segments: Segments along which a remedy is first tried, if there are at least twice
            as many; further ones for channels that hardly move in these. An arm of five joints has
            82 remedies, and their trials along 39 segments took 170 s.
        hopeless_ratio: Residual of this trial, relative to that of the recording as it was read,
            from which the remedy is not tried along all of them. It is above ``remedy_factor``, so
            that a remedy is not missed because its residual differs between the segments.
        most_suspects: Single channels are suspected only if at most this many joints are not
            explained. If one channel is wrong, its joint and those that it moves are not. If more
            joints are not, the model lacks something in each of them.
        shifts: Shifts of the commands, and of one channel, that are tried first, in steps.
        longest_delay: Longest time in seconds that a device takes to answer a command. Early time
            stamps of commands look the same, so only larger shifts are tried for them.
        long_shifts: Shifts longer than that which are tried, too, as multiples of it. At high
            sampling rates the other shifts are shorter.
        fewest_clipped: Fewest repeated measurements at the end of a range that can be a limit.
    """

    large_residual: float = 0.1
    disregarded_share: float = 0.2
    remedy_factor: float = 0.5
    most_remedies: int = 3
    most_segments: int = 200
    first_segments: int = 12
    hopeless_ratio: float = 0.8
    most_suspects: int = 3
    shifts: tuple[int, ...] = (1, 2, 4, 7, 10, 13, 16, 19)
    longest_delay: float = 0.04
    long_shifts: tuple[float, ...] = (1.25, 1.5, 1.75, 2.0, 2.25)
    fewest_clipped: int = 10

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self,
            0.0,
            1.0,
            "large_residual",
            "disregarded_share",
            "remedy_factor",
            "hopeless_ratio",
            "longest_delay",
        )
        check_range(self, 1.0, 100.0, "long_shifts")
        check_range(self, 1, 1000, "most_remedies", "most_segments", "most_suspects")
        check_range(self, 1, 100, "first_segments")
        if self.hopeless_ratio <= self.remedy_factor:
            raise ValueError("hopeless_ratio must be greater than remedy_factor.")
        check_range(self, 1, 1000, "shifts", "fewest_clipped")


@dataclass(frozen=True)
class HypothesisSettings:
    """The fit of a model with its effects.

    Attributes:
        least_penalised: Reference coordinate below which the prior penalty grows no further: a
            small effect is no less credible, and half-normal priors have zero strength at minus
            infinity.
        most_measurements: Number of measurements above which neighbouring ones are averaged before
            candidates are tested. With this many, ten thousand candidate columns take a minute.
            The benchmarks' recordings have fewer.
        least_averages: Fewest averages per segment: four for each of its ten pulses of force.
        implausible_coordinate: Absolute reference coordinate above which a value is implausible:
            three standard deviations of a normal prior.
        kept_bytes: Bytes of derivatives and differences from the recording that fitted models keep
            together. Older ones are dropped, and computed again when they are needed.
    """

    least_penalised: float = -1.0
    most_measurements: int = 100_000
    least_averages: int = 40
    implausible_coordinate: float = 3.0
    kept_bytes: int = 2**28

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, -10.0, 0.0, "least_penalised")
        check_range(self, 1, math.inf, "most_measurements", "least_averages", "kept_bytes")
        check_range(self, 1.0, 10.0, "implausible_coordinate")


@dataclass(frozen=True)
class VerdictSettings:
    """The verdict of a discovery.

    Attributes:
        most_unexplained: Share of the misfit that may stay unexplained. If more is left and the
            alarm detects it, the verdict is ``unknown``.
        most_undetected: The same limit for a remainder that the alarm does not detect, although
            the evidence for it is larger than that of ``TrialSettings.certain_evidence``.
        minor_share: Share of the explained misfit. Uncertain effects that together explain no more
            than this do not prevent the verdict ``named``. Where something remains that no law
            explains, an effect that explains no more than this is not named.
        fewest_deviations: Distance of a strength from zero, in standard deviations, from which it
            differs from zero.
        most_separated: Greatest number of alternatives, the likeliest, that the next experiment
            should separate.
    """

    most_unexplained: float = 0.01
    most_undetected: float = 0.05
    minor_share: float = 0.1
    fewest_deviations: float = 2.0
    most_separated: int = 3

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "most_unexplained", "most_undetected", "minor_share")
        check_range(self, 0.0, 10.0, "fewest_deviations")
        check_range(self, 2, 100, "most_separated")


REPAIR = RepairSettings()
HYPOTHESIS = HypothesisSettings()
VERDICT = VerdictSettings()
