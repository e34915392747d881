"""How discovery cuts a recording into segments."""

from dataclasses import replace

from npdr_ppl.errors import DataError
from npdr_ppl.preparation.data_options import (
    FEWEST_SEGMENTS,
    FEWEST_STEPS,
    DataOptions,
    checked_options,
    short_segment_length,
)
from npdr_ppl.rollouts import Rollouts

__all__ = ["segment_options", "short_segments"]


def segment_options(rollouts: Rollouts, options: DataOptions | None = None) -> DataOptions:
    """Returns options with the segment length in steps, after a check that discovery can use them.

    Args:
        rollouts: The recording.
        options: How it is prepared; the defaults if ``None``. Discovery compares trajectories
            themselves, so the result has no embedding.

    Raises:
        DataError: The recording is too short, or discovery cannot use an option.
    """
    options = checked_options(options)
    if options.initial_state != "uncertain":
        raise DataError(
            "Discovery estimates initial states with their errors: initial_state must be "
            f"'uncertain', got {options.initial_state!r}."
        )
    if options.noise != "auto":
        raise DataError(
            "Discovery estimates the noise from the residuals of its fits: noise must be 'auto', "
            f"got {options.noise!r}."
        )
    length = options.steps(rollouts)
    if length is None or length < 2:
        raise DataError(
            "Discovery tests short segments of a recording: segment_length must be 'auto' or a "
            "number of steps, at least 2; got "
            f"{'whole rollouts' if length is None else options.segment_length}."
        )
    fewest = FEWEST_STEPS if options.segment_length == "auto" else length
    if rollouts.num_usable < FEWEST_SEGMENTS * fewest:
        raise DataError(
            f"{rollouts.num_usable} steps are too few for {FEWEST_SEGMENTS} segments of "
            f"{fewest} steps; record more, or choose a shorter segment_length."
        )
    return replace(options, embedding=None, segment_length=length)


def short_segments(rollouts: Rollouts, options: DataOptions | None = None) -> DataOptions:
    """Returns the options with which a law is learned: by default, short segments.

    Formulas are compared by what they change in a motion to first order. In a long segment, what a
    model misses carries the motion too far for that.

    Args:
        rollouts: The recording.
        options: How it is prepared, before :func:`segment_options`; the defaults if ``None``.
    """
    options = checked_options(options)
    if options.segment_length == "auto":
        options = replace(options, segment_length=short_segment_length(rollouts))
    return segment_options(rollouts, options)
