"""Faults of a run: the draws that failed, how they failed, and which were lost."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

__all__ = ["Fault", "Faults"]


class Fault(StrEnum):
    """How a simulation failed."""

    CRASHED = "crashed"
    HUNG = "hung"
    NAN = "nan"
    RAISED = "raised"


@dataclass(frozen=True)
class Faults:
    """Faults of a run, or of several.

    A draw is counted each time it fails. A draw that crashes twice, for example, counts as crashed
    twice, retried once and lost.

    Attributes:
        num_draws: Number of draws that were run.
        crashed: Indices of draws whose process ended, in the order of events.
        hung: Indices of draws whose process was killed at the time limit.
        nan: Indices of draws that returned NaN or infinity.
        raised: Indices of draws that raised an error.
        retried: Indices of draws that were repeated.
        lost: Indices of draws that have no result.
        example: Message of one of the errors.
    """

    num_draws: int = 0
    crashed: tuple[int, ...] = ()
    hung: tuple[int, ...] = ()
    nan: tuple[int, ...] = ()
    raised: tuple[int, ...] = ()
    retried: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()
    example: str = ""

    @classmethod
    def of(cls, fault: Fault, index: int, *, is_retried: bool, example: str = "") -> "Faults":
        """Returns the faults of one failed draw.

        Args:
            fault: How it failed.
            index: Index of the draw.
            is_retried: Whether it will be repeated; if not, it is lost.
            example: Message of its error.
        """
        kinds: dict[str, tuple[int, ...]] = dict.fromkeys(_KINDS, ())
        kinds[fault.value] = (index,)
        kinds["retried" if is_retried else "lost"] = (index,)
        return cls(0, *(kinds[name] for name in _KINDS), example=example)

    def __add__(self, other: "Faults") -> "Faults":
        """Returns the sum of both."""
        return Faults(
            self.num_draws + other.num_draws,
            *(getattr(self, name) + getattr(other, name) for name in _KINDS),
            example=self.example or other.example,
        )

    def __bool__(self) -> bool:
        """Whether there is any fault."""
        return any(getattr(self, name) for name in _KINDS)

    def counts(self) -> dict[str, int]:
        """Returns the number of draws and of each kind of event."""
        return {"draws": self.num_draws} | {name: len(getattr(self, name)) for name in _KINDS}

    def to_dict(self) -> dict[str, Any]:
        """Returns the counts, and the lost draws, for JSON."""
        return {**self.counts(), "lost_draws": sorted(self.lost), "example": self.example}

    def __str__(self) -> str:
        counts = self.counts()
        failed = ", ".join(f"{counts[k.value]} {_WORDS[k]}" for k in Fault if counts[k.value])
        sentence = (
            f"Of {self.num_draws} simulations {failed or 'none failed'}; {len(self.retried)} were "
            f"run again and {len(self.lost)} are lost."
        )
        return f"{sentence} One said: {self.example}" if self.example else sentence


_KINDS = ("crashed", "hung", "nan", "raised", "retried", "lost")

_WORDS: Mapping[Fault, str] = {
    Fault.CRASHED: "crashed",
    Fault.HUNG: "hung",
    Fault.NAN: "returned NaN",
    Fault.RAISED: "raised an error",
}
