"""The option --segment-length: how recordings are cut into segments."""

from typing import TYPE_CHECKING, Annotated

import typer

from npdr_ppl.errors import DataError

if TYPE_CHECKING:
    from npdr_ppl.preparation.data_options import SegmentLength

__all__ = ["SegmentLengthOption", "resolve_segment_length"]

SegmentLengthOption = Annotated[
    str,
    typer.Option(
        help="Steps between re-synchronisations: a number, auto (0.2 s), or 0 for whole rollouts."
    ),
]


def resolve_segment_length(word: str) -> "SegmentLength":
    """Returns the segment length that a word describes.

    Raises:
        DataError: It is neither ``auto`` nor a number of steps.
    """
    if word == "auto":
        return "auto"
    if not word.isdecimal():
        raise DataError(f"--segment-length is a number of steps, auto or 0; got {word!r}.")
    return int(word) or None
