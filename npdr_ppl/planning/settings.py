"""The numbers of planning, in one validated object."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = ["PLANNING", "PlanningSettings"]


@dataclass(frozen=True)
class PlanningSettings:
    """The search for the next recording.

    Attributes:
        batch: Number of candidates that are judged together, fewer if a simulation has many steps.
        most_steps: Greatest number of simulated steps for the derivatives of a batch. With an arm
            of seven joints at 1 kHz in MuJoCo, a million takes 6 s on one core.
        fewest_segments: Number of segments of each candidate that are judged at least during the
            search; the result is judged with all.
        tried_per_place: Number of candidates that are simulated for each one that is judged. A
            simulation costs little compared with derivatives by all parameters, and most random
            candidates of a passive joint leave its limits.
        most_weaker: How often a batch is simulated, each time weaker, until half of it keeps the
            limits. Each time makes it up to five times weaker.
        first_batches: Number of batches of random candidates before the best ones are refined.
        elites: Number of candidates that are refined side by side.
        step: First standard deviation of a refinement, relative to the coefficients' own size.
        shrink: Factor of this step after a round that improved nothing.
        least_step: Smallest step.
        amplitudes: Multiples of the greatest permitted amplitude that random candidates have.
        least_room: A command at rest that is closer to a limit than this share of its range moves
            about the middle of the range. About itself, it could not move if it is at the limit,
            as the goal of a servo that starts at its end stop.
        margin: Share of a limit that simulations keep free, because the robot is not the model.
        least_motion: Motion, as a share of the recorded one or of what the limits permit, below
            which squared separations shrink with its square. Plans that moved a pendulum by 1 to
            7 % of what it may were predicted to tell its frictions apart and did not
            (``benchmarks/planning.py``, seeds 2173 and 2174).
        greatest_step_error: Greatest deviation of the integration error of one cause from the mean
            of all, along random candidates, in standard deviations of the measurements. Two causes
            can differ by twice as much. Candidates that a search had found deviated by up to five
            times as much as random ones (``benchmarks/planning.py``, cart-pole, seed 2183).
        num_draws: Number of prior draws over which information is averaged.
        num_smoothed: Number of simulated recordings from which the errors of initial states are
            estimated.
        num_noises: Number of noise draws per simulated recording for the errors of its first
            state. A recording has many segments, but only one first state.
        relative_noise: Standard deviation of a channel's noise as a share of its rated value, if
            nothing is known. An encoder of 4096 counts per turn has 0.0004 rad.
        pool: Greatest number of the best candidates, and of random ones, among which the rollouts
            of a plan are chosen.
        most_recorded: Greatest total duration in seconds of the rollouts of a plan. The user can
            ask for more, and a plan has at least one rollout.
        least_chance_gain: If the wanted chance is not reached, the last rollouts are left out if
            together they add less than this. It is twice the greatest standard error of a chance.
        most_needed: Greatest number of rollouts up to which the number that would be needed is
            told; more of 10 s each take over 10 minutes.
        search_share: Share of the time limit for the search, if there are causes to tell apart.
            The rest is for what would be possible with wider limits.
        wanted: Chance of naming the right cause from which no further rollout is added. Another
            rollout takes seconds, another plan a further session with the robot.
        least_likely: Probability of a cause that was stored as zero.
        num_datasets: Number of simulated recordings from which the chance of naming is computed;
            its standard error is at most 0.025.
        num_resamplings: Number of resamplings of the evidence of each; discovery has 1000.
        most_seconds: Longest default duration in seconds.
        prior_seconds: Default duration without a recording.
        prior_bandwidth: Default bandwidth in Hz without a recording.
    """

    batch: int = 12
    most_steps: int = 1_000_000
    fewest_segments: int = 8
    tried_per_place: int = 3
    most_weaker: int = 4
    first_batches: int = 3
    elites: int = 3
    step: float = 0.5
    shrink: float = 0.8
    least_step: float = 0.05
    amplitudes: tuple[float, ...] = (1.0, 0.7, 0.45, 0.25, 0.1)
    least_room: float = 0.25
    margin: float = 0.05
    least_motion: float = 0.25
    greatest_step_error: float = 0.25
    num_draws: int = 5
    num_smoothed: int = 3
    num_noises: int = 8
    relative_noise: float = 1e-3
    pool: int = 24
    most_recorded: float = 120.0
    least_chance_gain: float = 0.05
    most_needed: int = 60
    search_share: float = 0.7
    wanted: float = 0.95
    least_likely: float = 1e-6
    num_datasets: int = 400
    num_resamplings: int = 100
    most_seconds: float = 10.0
    prior_seconds: float = 5.0
    prior_bandwidth: float = 2.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "most_steps", "fewest_segments")
        check_range(
            self, 1, 1000, "batch", "tried_per_place", "most_weaker", "first_batches", "num_draws"
        )
        check_range(self, 1, 100, "num_smoothed", "num_noises", "pool", "most_needed")
        check_range(self, 10, 10_000, "num_datasets", "num_resamplings")
        check_range(self, 1, self.batch, "elites")
        check_range(self, 0.0, 1.0, "step", "shrink", "least_step", "amplitudes", "margin")
        check_range(self, 0.0, 1.0, "wanted", "least_likely", "search_share", "least_motion")
        check_range(self, 0.0, 1.0, "least_chance_gain")
        check_range(self, 0.0, 0.5, "least_room")
        check_range(self, 0.0, 100.0, "greatest_step_error")
        check_range(self, 0.0, 1.0, "relative_noise")
        check_range(self, 0.1, math.inf, "most_seconds", "most_recorded", "prior_seconds")
        check_range(self, 0.1, math.inf, "prior_bandwidth")


PLANNING = PlanningSettings()
