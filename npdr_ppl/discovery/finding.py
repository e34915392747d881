"""An effect that was missing, with its probability and its parameters."""

from dataclasses import dataclass
from typing import Any

from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.language.effects import Effect

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """An effect that was missing.

    Attributes:
        effect: The effect.
        probability: That it is this one, given all others found.
        alternatives: Probabilities of what could stand in its place, itself included, by name.
        equivalent_to: Ids of causes that the recording may not tell from it.
        share: Share of the misfit that it explains.
        parameters: Its parameters' estimates by short name.
        at_edge: Those that give it its shape and lie where their priors hardly go, or may as
            well lie there: its law is then the limit of its own that another law may be.
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    equivalent_to: tuple[str, ...]
    share: float
    parameters: dict[str, Estimate]
    at_edge: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "effect": self.effect.id,
            "port": self.effect.port,
            "probability": self.probability,
            "equivalent_to": list(self.equivalent_to),
            "alternatives": self.alternatives,
            "share": self.share,
            "parameters": {name: e.to_dict() for name, e in self.parameters.items()},
            "at_edge": list(self.at_edge),
        }
