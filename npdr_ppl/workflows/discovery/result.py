"""What discovery found."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import num_finer_steps
from npdr_ppl.rollouts.atomic import replacing
from npdr_ppl.workflows.discovery.alarm import Alarm
from npdr_ppl.workflows.discovery.counts import Count
from npdr_ppl.workflows.discovery.credible import Draws, Estimate
from npdr_ppl.workflows.discovery.next_experiment import NextExperiment
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.prior_ends import PriorEnd
from npdr_ppl.workflows.discovery.proof import Gap
from npdr_ppl.workflows.discovery.residual_map import Spot
from npdr_ppl.workflows.discovery.revised_model import revised_source
from npdr_ppl.workflows.discovery.screening import Screened
from npdr_ppl.workflows.discovery.search import Search
from npdr_ppl.workflows.run_folder import write_json

__all__ = ["Discovery", "Finding", "Verdict", "describe_candidate"]

Verdict = Literal["none", "named", "ambiguous", "unknown"]
"""Nothing is missing; what is missing has a name; it has several names that the recording cannot
tell apart; it is none of the catalogue."""


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


@dataclass(frozen=True)
class Discovery:
    """What discovery found.

    Attributes:
        verdict: What the recording says of the model.
        reason: The verdict in a sentence.
        problems: What is wrong with the recording itself; nothing is named then.
        narrow_priors: Priors outside which the revised model's parameters lie; the search was made
            with wider ones.
        alarm: Whether the model as it was and the recording disagree.
        remainder: The same for the revised model.
        unexplained: Share of the misfit that the revised model leaves and something could explain.
        where: The windows that the model as it was misses most, the worst first.
        effects: What was missing, in the order of finding.
        ranking: All candidates at the model as it was, by linear gain.
        separation: Distance between the leading candidates once parameters are refitted, in
            standard deviations, ``(n, n)``; the diagonal is the distance from none.
        separation_names: Their names.
        gap: Metrics on the held-out recording; empty without one.
        next_experiment: What to record next, where candidates could not be told apart.
        model: The model as it was.
        revised: The model with the effects.
        parameters: All parameters' estimates in the revised model, by site.
        draws: Draws of the revised model's posterior.
        counts: Channels that are read in whole counts, as an encoder's, and what rounding makes
            of what the revised model leaves there.
        search: How it was found.
        options: How it was searched.
        seconds: Time spent, by stage.
    """

    verdict: Verdict
    reason: str
    problems: tuple[str, ...]
    narrow_priors: tuple[PriorEnd, ...]
    alarm: Alarm
    remainder: Alarm
    unexplained: float
    where: list[Spot]
    effects: list[Finding]
    ranking: list[Screened]
    separation: Tensor
    separation_names: tuple[str, ...]
    gap: dict[str, Gap]
    next_experiment: NextExperiment | None
    model: Callable[..., Any]
    revised: Callable[..., Any]
    parameters: dict[str, Estimate]
    draws: Draws
    counts: dict[str, Count]
    search: Search
    options: DiscoveryOptions
    seconds: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values; architecture's names, and more."""
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "data_problems": list(self.problems),
            "priors_too_narrow": [str(end) for end in self.narrow_priors],
            "alarm": {"p_value": self.alarm.p_value, "fired": self.alarm.fired},
            "remainder": {
                "p_value": self.remainder.p_value,
                "fired": self.remainder.fired,
                "unexplained": self.unexplained,
            },
            "where": [spot.to_dict() for spot in self.where],
            "finer_steps": num_finer_steps(self.revised),
            "effects": [finding.to_dict() for finding in self.effects],
            "ranking": [describe_candidate(s, self.alarm.p_values[s.name]) for s in self.ranking],
            "separation": {
                "names": list(self.separation_names),
                "distance": self.separation.tolist(),
            },
            "gap": {name: gap.to_dict() for name, gap in self.gap.items()},
            "next_experiment": self.next_experiment and self.next_experiment.to_dict(),
            "parameters": {name: e.to_dict() for name, e in self.parameters.items()},
            "counts": {name: count.to_dict() for name, count in self.counts.items()},
            "seconds": self.seconds,
        }

    def source(self) -> str:
        """Returns the revised model as Python source."""
        effects = tuple(finding.effect for finding in self.effects)
        fitted = {
            name: float(value)
            for name, value in self.search.final.parameters.items()
            if torch.as_tensor(value).numel() == 1
        }
        return revised_source(self.model, effects, fitted)

    def save(self, folder: Path) -> None:
        """Writes ``revised_model.py`` and then ``discovery.json``, which makes it count.

        Args:
            folder: Where to; made if it is not there.
        """
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / "revised_model.py") as temporary:
            temporary.write_text(self.source(), encoding="utf-8")
        write_json(folder / "discovery.json", self.to_dict())

    def plot(self, axes: Any = None) -> Any:
        """Draws the probabilities of what was missing and the gap on held-out rollouts.

        :func:`~npdr_ppl.plots.discovery_figures.write_discovery_figures` draws all the rest.

        Args:
            axes: Where to draw: a panel for each effect, or one of what was tried where none was
                added, and one for each metric that has a noise floor; ``None`` for a new figure.

        Returns:
            The axes, one per panel.
        """
        from npdr_ppl.workflows.discovery.notebook import plot_discovery

        return plot_discovery(self, axes)

    def _repr_html_(self) -> str:
        from npdr_ppl.workflows.discovery.notebook import discovery_html

        return discovery_html(self)

    def __repr__(self) -> str:
        found = ", ".join(f"{f.effect.name} ({f.probability:.0%})" for f in self.effects)
        return f"Discovery({self.verdict}{': ' + found if found else ''})"


def describe_candidate(candidate: Screened, p_value: float) -> dict[str, Any]:
    """Returns a candidate of the ranking as JSON-serialisable values."""
    effect = candidate.variant.effect
    return {
        "effect": effect.id,
        "port": effect.port,
        "gain": candidate.gain,
        "separation": candidate.separation,
        "absorbed": candidate.absorbed,
        "p_value": p_value,
        "estimate": {
            name.removeprefix(f"{effect.name}."): float(value)
            for name, value in candidate.variant.parameters(candidate.sizes).items()
        },
        "minimum_detectable": candidate.minimum_detectable,
    }
