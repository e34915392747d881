"""The numbers of the search for faults of a recording, as one validated object."""

from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = ["FAULTS", "FaultSettings"]


@dataclass(frozen=True)
class FaultSettings:
    """Limits of what a moving device can do between two measurements.

    Chosen on the public recordings and on simulated Furuta pendulums with swing-ups, impacts and
    rests.

    Attributes:
        jump_size: Departure from a smooth motion that no motion makes, in standard deviations of
            the channel's departures nearby: of spikes, jumps and the last row.
        spike_change: Least size of a spike, in medians of the channel's changes that are not zero.
        mended_share: Share of a departure that may be left after a fault is mended.
        off_course_share: Least distance of a spike from the line through the two measurements
            before it and from the line through the two after it, as a share of its departure from
            a smooth motion. A spike has a share of one. At a kink, a measurement is off one of the
            lines at most by its noise.
        contradicted_share: Share of a spike of a position that its rate must leave unexplained, in
            the steps before and after it. A driver that differentiates the position gives a rate
            that explains half of it; at an impact, the rate explains one of the steps.
        largest_loss: Most samples whose loss is recognised by the jump in time that explains all
            channels. Longer gaps are jumps of most channels.
        left_over: Share of a channel's jump that may be left if its cause is the right one.
        joint_departure: Least departure of a channel that decides, in standard deviations.
        rest_change: A channel rests in a step if it changes by less than this fraction of its
            root-mean-square change.
        least_steps: Least number of steps of a stretch that is checked.
        most_lost: If more than this share of the steps are jumps, they are taken for the device's
            motion.
        frozen_change: Least change that a frozen channel should have made, in medians of its
            changes that are not zero.
        frozen_share: Least root-mean-square rate of a frozen position, as a share of its fastest;
            less may be the bias of the rate's sensor.
        least_freeze: Least number of equal measurements of a frozen channel.
    """

    jump_size: float = 12.0
    spike_change: float = 4.0
    mended_share: float = 0.1
    off_course_share: float = 0.5
    contradicted_share: float = 0.25
    largest_loss: int = 10
    left_over: float = 0.3
    joint_departure: float = 5.0
    rest_change: float = 0.01
    least_steps: int = 20
    most_lost: float = 0.02
    frozen_change: float = 4.0
    frozen_share: float = 0.1
    least_freeze: int = 10

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self,
            0.0,
            1.0,
            "rest_change",
            "most_lost",
            "frozen_share",
            "mended_share",
            "off_course_share",
            "contradicted_share",
            "left_over",
        )
        check_range(
            self,
            1,
            1000,
            "jump_size",
            "spike_change",
            "least_steps",
            "frozen_change",
            "least_freeze",
            "largest_loss",
            "joint_departure",
        )


FAULTS = FaultSettings()
