"""How measured data are prepared for inference: the options that all commands share."""

from dataclasses import dataclass, replace
from typing import Literal

import torch

from npdr_ppl.embeddings import Embedding
from npdr_ppl.errors import DataError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import InitialState, layout_of, motion

__all__ = [
    "MAX_READINGS_PER_CHUNK",
    "PLAIN_FEATURES",
    "DataOptions",
    "SegmentLength",
    "checked_options",
    "default_segment_length",
    "one_of_each_part",
    "short_segment_length",
]

MAX_READINGS_PER_CHUNK = 2_000_000
"""Greatest number of measurements in one chunk of simulations, 16 MiB in float64. Larger arrays do
not fit in the cache, and the allocator maps their memory again every time. With smaller ones the
overhead of the calls dominates."""

SEGMENT_SECONDS = 0.2
"""Default length of a segment in s, unless the motion is slow. It is long compared with delays
and lags, and short compared with the time in which an unstable motion amplifies errors of the
initial state."""

FEWEST_STEPS, MOST_STEPS = 20, 200
"""Bounds of a segment's default length in steps. Shorter segments need most of their measurements
for their initial states. Longer ones need more memory and contain no more information."""

FEWEST_SEGMENTS = 8
"""Least number of segments of a recording that is long enough. With fewer, a test cannot
distinguish an effect from chance."""

MANY_SEGMENTS = 4 * FEWEST_SEGMENTS
"""Least number of segments that are longer because the motion is slow: four times as many, so that
halves of the recording and halves of these can be tested."""

MOST_READINGS = 80_000
"""Greatest number of measurements that a fit uses, in at least ``FEWEST_SEGMENTS`` segments; 11 s
of 7 channels at 1 kHz. The derivatives of all measurements are in memory together; the search of
an arm of seven joints in ``benchmarks/memory.py`` needed 1.93 GiB with 100 000."""

PLAIN_FEATURES = "bayessim"
"""Features if there is no closest fit, at which the score features are computed."""

SegmentLength = int | Literal["auto"] | None
"""Steps between re-synchronisations: a number, ``"auto"`` for :func:`default_segment_length`, or
``None`` for whole rollouts."""


def default_segment_length(rollouts: Rollouts) -> int:
    """Returns the default length of a segment in steps.

    It is ``SEGMENT_SECONDS``, or the time after which the motion is no longer a straight line, if
    that is longer and leaves ``MANY_SEGMENTS``: a shorter part of a slow motion follows from its
    initial state whatever the parameters are. It is within ``FEWEST_STEPS`` and ``MOST_STEPS``. A
    recording that would have fewer than ``FEWEST_SEGMENTS`` segments of this length is cut into
    twice ``FEWEST_SEGMENTS``.
    """
    slow = min(rollouts.motion_time / rollouts.time_step, rollouts.num_usable // MANY_SEGMENTS)
    return _length_near(round(max(SEGMENT_SECONDS / rollouts.time_step, slow)), rollouts)


def short_segment_length(rollouts: Rollouts) -> int:
    """Returns the default length in steps without regard to how slow the motion is."""
    return _length_near(round(SEGMENT_SECONDS / rollouts.time_step), rollouts)


def _length_near(length: int, rollouts: Rollouts) -> int:
    """Returns a length in steps within the bounds that every default has."""
    length, total = max(FEWEST_STEPS, min(MOST_STEPS, length)), rollouts.num_usable
    if total >= FEWEST_SEGMENTS * length:
        return length
    return max(2, min(length, total // (2 * FEWEST_SEGMENTS)))


@dataclass(frozen=True)
class DataOptions:
    """How measured data are prepared for inference.

    Attributes:
        embedding: Maps trajectories to features: a name such as ``"bayessim"`` or ``"all/10"``,
            your own embedding, or ``"score"``, which
            :func:`~npdr_ppl.posterior.prepare.prepare` computes for a recording. Not used for
            plain functions.
        segment_length: Steps between re-synchronisations; see :data:`SegmentLength`.
        initial_state: How the state at a segment's start is found: ``"uncertain"`` estimates it
            and takes the estimate's error into account; ``"estimated"`` takes the estimate as
            exact, and ``"recorded"`` the measurement. If measurements have noise, the last two
            give posteriors that are too narrow and biased.
        precision: Floating-point type of the simulation, ``"float64"`` or ``"float32"``.
        noise: ``"auto"`` estimates the noise of a model that declares none, from the residuals of
            its closest fit, if initial states are uncertain; ``"model"`` keeps the model's noise.
        strict: Whether a recording with faults is refused instead of repaired.
        commands_before: Commands before a rollout, which delays and lags need: ``"zero"``, the
            ``"first"`` ones, as where a log was cut from a flight, or ``"auto"``, which
            :func:`~npdr_ppl.preparation.commands_before.began_in_operation` decides if initial
            states are uncertain, and otherwise is ``"zero"``. Servos held their first goals in any
            case.

    Raises:
        DataError: ``commands_before`` is none of these.
    """

    embedding: str | Embedding | None = "score"
    segment_length: SegmentLength = "auto"
    initial_state: InitialState = "uncertain"
    precision: Literal["float64", "float32"] = "float64"
    noise: Literal["auto", "model"] = "auto"
    strict: bool = False
    commands_before: Literal["auto", "zero", "first"] = "auto"

    def __post_init__(self) -> None:
        """Checks the commands before a rollout."""
        if self.commands_before not in ("auto", "zero", "first"):
            raise DataError(
                "commands_before is 'auto', 'zero' or 'first', which were the commands before a "
                f"rollout; got {self.commands_before!r}."
            )

    @property
    def dtype(self) -> torch.dtype:
        """The precision as torch's type."""
        return {"float64": torch.float64, "float32": torch.float32}[self.precision]

    def inputs(self, rollouts: Rollouts) -> Inputs:
        """Returns the inputs of the segments that are used; see :meth:`num_segments`."""
        inputs = self.every_segment(rollouts)
        index = self.used_segments(rollouts)
        return inputs if len(index) == inputs.num_segments else inputs.segments(index)

    def every_segment(self, rollouts: Rollouts) -> Inputs:
        """Returns the inputs of all segments, from which whole rollouts can be stitched."""
        inputs = rollouts.inputs(self.steps(rollouts), self.initial_state, dtype=self.dtype)
        return replace(inputs, began_in_operation=self.commands_before == "first")

    def used_segments(self, rollouts: Rollouts) -> torch.Tensor:
        """Returns the indices of the segments that are used, among all of them."""
        used, every = self.num_segments(rollouts)
        if used == every:
            return torch.arange(every)
        return one_of_each_part(
            used, every, seed=0, weights=motion(rollouts, self.steps(rollouts))
        )

    def num_segments(self, rollouts: Rollouts) -> tuple[int, int]:
        """Returns how many segments of rollouts are used, and how many there are.

        Of a very long recording, one segment of each of equal parts is used, if initial states
        are uncertain; see ``MOST_READINGS``. The more a segment moves, the more likely it is the
        one, because standstill tells little. Otherwise all are used.
        """
        length = self.steps(rollouts) or max(rollouts.lengths)
        every = len(layout_of(rollouts, self.steps(rollouts)))
        if self.initial_state != "uncertain":
            return every, every
        most = MOST_READINGS // (length * len(rollouts.channel_names))
        return min(every, max(FEWEST_SEGMENTS, most)), every

    def steps(self, rollouts: Rollouts) -> int | None:
        """Returns the length of a segment of rollouts; ``None`` for whole rollouts."""
        if self.segment_length == "auto":
            return default_segment_length(rollouts)
        return self.segment_length

    def with_certain_start(self) -> "DataOptions":
        """Returns the options that start every simulation from the best estimate."""
        if self.initial_state != "uncertain":
            return self
        return replace(self, initial_state="estimated")


def one_of_each_part(
    num_parts: int, num: int, *, seed: int, weights: torch.Tensor | None = None
) -> torch.Tensor:
    """Returns a random index of each of equal parts of a range, ``(num_parts,)``, in order.

    Indices at equal distances could always meet the same phase of a periodic excitation.

    Args:
        num_parts: Number of parts, at most ``num``.
        num: Length of the range.
        seed: Seed of the choice.
        weights: What the probability of an index within its part is proportional to, ``(num,)``;
            equal by default, and in parts without any weight.
    """
    ends = torch.arange(num_parts + 1) * num // num_parts
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(num_parts, generator=generator, dtype=torch.float64)
    if weights is None:
        return ends[:-1] + (share * ends.diff()).long()
    chosen = []
    for first, end, level in zip(ends[:-1].tolist(), ends[1:].tolist(), share, strict=True):
        own = weights[first:end] if weights[first:end].any() else torch.ones(end - first)
        below = own.double().cumsum(0)
        chosen.append(first + int((below <= level * below[-1]).sum()))
    return torch.tensor(chosen)


def checked_options(
    options: DataOptions | None, default: DataOptions | None = None
) -> DataOptions:
    """Returns the options that a function was given, or its default ones.

    Raises:
        DataError: ``options`` is of another type.
    """
    if options is None:
        return default or DataOptions()
    if not isinstance(options, DataOptions):
        raise DataError(
            f"options takes a DataOptions, which says how rollouts are prepared; got {options!r}."
        )
    return options
