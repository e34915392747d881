"""Notes of a recording: which ones report a fault, and which ones only say how it was read."""

from collections.abc import Iterable

__all__ = ["Remark", "faults_among", "remarks_among"]


class Remark(str):
    """A note that reports no fault, e.g. which column was taken as the time.

    All other notes report faults: something was left out or changed because it was wrong.
    ``--strict`` refuses a recording with a fault.
    """

    __slots__ = ()


def faults_among(notes: Iterable[str]) -> tuple[str, ...]:
    """Returns the notes that report a fault."""
    return tuple(note for note in notes if not isinstance(note, Remark))


def remarks_among(notes: Iterable[str]) -> tuple[str, ...]:
    """Returns the notes that report no fault, as plain text."""
    return tuple(str(note) for note in notes if isinstance(note, Remark))
