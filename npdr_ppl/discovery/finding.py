"""An effect that was missing, with its probability and its parameters."""

from dataclasses import dataclass
from typing import Any

from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.discovery.search.parts import PartResult, doubt_of
from npdr_ppl.discovery.search.repeatability import HALVES, Repetition
from npdr_ppl.language.effects import Effect

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """An effect that was missing.

    Attributes:
        effect: The effect.
        probability: Probability that it is this effect, given all other effects found. Less likely
            laws that contain it and fit hardly better count, too: the recording does not tell
            their shape.
        alternatives: Probabilities by name, of this effect and of those that could replace it,
            without those that count for it.
        equivalent_to: Ids of causes that the recording possibly cannot distinguish from it; names
            of the same law elsewhere.
        share: Share of the misfit that it explains.
        parameters: Its parameters' estimates by short name.
        at_edge: Names of shape parameters with an implausible value, or with a value that the
            recording cannot distinguish from an implausible one. The law may then equal another
            law.
        is_minor: Whether it explains too little to be named: no strength differs from zero by two
            standard deviations, or something remains that no law explains, its share is small, and
            little is lost without it and all other small ones.
        corrects: Number of the model that it corrects; empty if it is a missing effect. See
            :meth:`~npdr_ppl.language.simulator.Simulator.corrected_number`.
        repetition: Its strengths in parts of the recording; ``None`` for short recordings.
        found_in: Whether each half of the recording shows it, and the recording without each of
            its rollouts; empty if it was not sought there.
        is_compared: Whether it was compared with alternatives. If a time limit prevented it, the
            probability says nothing.
        may_be_step_error: Whether it is shorter than a time step of a simulator that has no finer
            steps, so that it may be what the steps miss.
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    equivalent_to: tuple[str, ...]
    share: float
    parameters: dict[str, Estimate]
    at_edge: tuple[str, ...] = ()
    is_minor: bool = False
    corrects: str = ""
    repetition: Repetition | None = None
    found_in: tuple[PartResult, ...] = ()
    is_compared: bool = True
    may_be_step_error: bool = False

    @property
    def is_found_again(self) -> bool:
        """Whether its strengths in parts of the recording do not contradict each other."""
        return self.repetition is None or self.repetition.is_found_again

    @property
    def can_be_named(self) -> bool:
        """Whether it is missing, large enough, and there is no doubt of it."""
        return not self.is_minor and not self.corrects and not self.doubt

    def is_sure(self, confidence: float) -> bool:
        """Returns whether it can be named and is likely enough.

        Args:
            confidence: Probability above which one cause is named.
        """
        return self.can_be_named and self.probability >= confidence

    @property
    def doubt(self) -> str:
        """Why it is no cause although it explains something, to follow its name; else empty.

        See :attr:`may_be_step_error` and :func:`doubt_of`.
        """
        if self.may_be_step_error:
            return "is shorter than a time step, and may be the error of the simulator's own steps"
        return doubt_of(self.found_in)

    @property
    def in_halves(self) -> dict[str, bool]:
        """Whether each half of the recording shows it, by the half's name."""
        return {part.part: part.is_found for part in self.found_in if part.part in HALVES}

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "effect": self.effect.id,
            "port": self.effect.port,
            "probability": self.probability if self.is_compared else None,
            "equivalent_to": list(self.equivalent_to),
            "alternatives": self.alternatives if self.is_compared else {},
            "share": self.share,
            "constants": self.effect.constants,
            "parameters": {name: e.to_dict() for name, e in self.parameters.items()},
            "at_edge": list(self.at_edge),
            "is_minor": self.is_minor,
            "corrects": self.corrects,
            "is_found_again": self.is_found_again,
            "parts": [] if self.repetition is None else self.repetition.to_list(),
            "in_halves": self.in_halves,
            "found_in": [part.to_dict() for part in self.found_in],
            "doubt": self.doubt,
        }
