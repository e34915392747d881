"""The result of a discovery."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from npdr_ppl.atomic_files import replacing
from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.result import Learned
from npdr_ppl.discovery.proof.estimated_anew import EstimatedAnew
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.proof.next_experiment import NextExperiment
from npdr_ppl.discovery.proof.overlays import Overlays
from npdr_ppl.discovery.proof.parameter_intervals import Draws, Estimate
from npdr_ppl.discovery.proof.residual_map import Spot
from npdr_ppl.discovery.proof.surviving_causes import SurvivingCauses
from npdr_ppl.discovery.revised_model import revised_source
from npdr_ppl.discovery.screening.alarm import Alarm
from npdr_ppl.discovery.screening.encoder_resolution import Count
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.prior_ends import PriorEnd
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.language.handlers import num_finer_steps
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import wider_sites
from npdr_ppl.preparation.preparation_summary import PreparationSummary
from npdr_ppl.randomness import seeded
from npdr_ppl.run_files import save_tensors, write_json

__all__ = ["DRAWS", "Discovery", "Verdict", "describe_candidate"]

DRAWS = "draws.safetensors"
"""Name of the file with draws of the revised model's posterior."""

NUM_DRAWS = 1_000
"""Number of draws in this file, as many as a fit keeps of each member."""

Verdict = Literal["none", "named", "ambiguous", "unknown", "learned"]
"""``none``: no effect is missing. ``named``: the missing effects are known. ``ambiguous``: the
recording cannot tell several causes apart. ``unknown``: the cause is none of the catalogue.
``learned``: likewise, and a law was learned that helps wherever it was checked."""


@dataclass(frozen=True)
class Discovery:
    """The result of a discovery.

    Attributes:
        verdict: One word; see :data:`Verdict`.
        reason: The reason for the verdict, in a sentence.
        preparation: How the recording was prepared.
        problems: The faults of the recording and what was done about them, a sentence each.
        remarks: How the recording was read, a sentence each; these are no faults.
        narrow_priors: Priors that do not contain the revised model's parameters; the search used
            wider ones.
        alarm: Whether the original model and the recording disagree.
        remainder: The same for the revised model.
        unexplained: Share of the misfit that the revised model leaves and one law could explain.
        where: The windows in which the original model fits worst, the worst first.
        effects: The missing effects; the one that explains most comes first.
        ranking: All candidates for the original model, by linear gain.
        separation: Distance between the leading candidates once parameters are refitted, in
            standard deviations, ``(n, n)``; the diagonal is the distance from no effect.
        separation_names: Names of the leading candidates.
        gap: Metrics on the held-out recording; empty without one.
        anew: Parameters that belong to a recording, as an encoder's zero does, estimated anew on
            the held-out one; ``None`` if there are none.
        next_experiment: What to record next, if candidates could not be told apart.
        causes: The causes that the recording leaves possible, for ``npdr plan``.
        model: The original model.
        revised: The model with the effects.
        parameters: Estimates of all parameters of the revised model, by site.
        draws: Draws of the revised model's posterior.
        counts: Encoder resolution by channel, where there is one, and the share of the revised
            model's residual variance that rounding to it causes.
        overlays: Measurements and simulations of the held-out rollouts, or else of the recording.
        search: The course of the search.
        settings: Settings of the search.
        seed: Seed of all random numbers.
        seconds: Time spent, by stage.
        learned: The law that was learned because no effect explains the recording, if one was
            asked for and found.
    """

    verdict: Verdict
    reason: str
    preparation: PreparationSummary
    problems: tuple[str, ...]
    remarks: tuple[str, ...]
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
    anew: EstimatedAnew | None
    next_experiment: NextExperiment | None
    causes: SurvivingCauses
    model: Model
    revised: Callable[..., Any]
    parameters: dict[str, Estimate]
    draws: Draws
    counts: dict[str, Count]
    overlays: Overlays
    search: Search
    settings: DiscoveryOptions
    seed: int
    seconds: dict[str, float]
    learned: Learned | None = None

    @property
    def final(self) -> Hypothesis:
        """The revised model, fitted to the recording."""
        if self.learned is not None and self.learned.is_offered:
            return self.learned.model.hypothesis
        return self.search.final

    @property
    def named(self) -> list[str]:
        """Names of the effects that the verdict ``named`` names, empty with another verdict."""
        if self.verdict != "named":
            return []
        return [f.effect.name for f in self.effects if f.is_sure(self.settings.confidence)]

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values, the content of ``discovery.json``."""
        return {
            "verdict": self.verdict,
            "named": self.named,
            "reason": self.reason,
            "has_stopped": self.search.has_stopped,
            "preparation": self.preparation.to_dict(),
            "data_problems": list(self.problems),
            "remarks": list(self.remarks),
            "priors_too_narrow": [str(end) for end in self.narrow_priors],
            "alarm": {"p_value": self.alarm.p_value, "fired": self.alarm.fired},
            "remainder": {
                "p_value": self.remainder.p_value,
                "fired": self.remainder.fired,
                "unexplained": self.unexplained,
            },
            "where": [spot.to_dict() for spot in self.where],
            "finer_steps": num_finer_steps(self.revised),
            "wider_priors": wider_sites(self.revised),
            "effects": [finding.to_dict() for finding in self.effects],
            "ranking": [describe_candidate(s, self.alarm.p_values[s.name]) for s in self.ranking],
            "separation": {
                "names": list(self.separation_names),
                "distance": self.separation.tolist(),
            },
            "gap": {name: gap.to_dict() for name, gap in self.gap.items()},
            "estimated_anew": {} if self.anew is None else self.anew.to_dict(),
            "next_experiment": self.next_experiment and self.next_experiment.to_dict(),
            "surviving_causes": self.causes.to_dict(),
            "parameters": {name: e.to_dict() for name, e in self.parameters.items()},
            "counts": {name: count.to_dict() for name, count in self.counts.items()},
            "learned": self.learned and self.learned.to_dict(),
            "seconds": self.seconds,
        }

    def source(self) -> str:
        """Returns the revised model as Python source."""
        effects, written = tuple(finding.effect for finding in self.effects), ""
        if self.learned is not None and self.learned.is_offered:
            effects, written = (*effects, *self.learned.effects), self.learned.source()
        fitted = {
            name: float(value)
            for name, value in self.final.parameters.items()
            if torch.as_tensor(value).numel() == 1
        }
        return revised_source(self.model, effects, fitted, written)

    def learned_source(self) -> str | None:
        """Returns the learned effects as Python source; ``None`` if there are none to offer."""
        if self.learned is None or not self.learned.is_offered:
            return None
        name = getattr(self.model, "__name__", "")
        return self.learned.source(f"Learned from a recording of {name}, seed {self.seed}.")

    def save(self, folder: Path) -> None:
        """Writes ``revised_model.py``, a learned effect, and last ``discovery.json``.

        ``discovery.json`` marks the folder complete.

        Args:
            folder: The folder; created if it does not exist.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.save_model(folder)
        write_json(folder / "discovery.json", self.to_dict())

    def save_model(self, folder: Path) -> None:
        """Writes ``revised_model.py``, draws of its posterior, and a learned effect if any.

        Args:
            folder: The folder, which exists.
        """
        if (learned := self.learned_source()) is not None:
            with replacing(folder / "learned_effect.py") as temporary:
                temporary.write_text(learned, encoding="utf-8")
        with replacing(folder / "revised_model.py") as temporary:
            temporary.write_text(self.source(), encoding="utf-8")
        write_json(folder / "overlays.json", self.overlays.to_dict())
        save_tensors(folder / DRAWS, self.sample(NUM_DRAWS, seed=self.seed))

    def sample(self, num: int, *, seed: int = 0) -> dict[str, Tensor]:
        """Returns draws of the posterior of every scalar parameter, ``(num,)`` each.

        Args:
            num: Number of draws.
            seed: Seed of the choice among the weighted draws.
        """
        with seeded(seed, "discovery", "draws"):
            z = self.draws.smoothed().resampled(num)
        values = self.final.segments.prior.to_parameters(z)
        return {n: v.double().flatten() for n, v in values.items() if v[0].numel() == 1}

    def plot(self, axes: Any = None) -> Any:
        """Draws the probabilities of the alternatives and the gap on held-out rollouts.

        :func:`~npdr_ppl.display.plots.discovery_figures.write_discovery_figures` draws all other
        figures.

        Args:
            axes: One for each effect, or one for the tried candidates if no effect was added, and
                one for each metric that has a noise floor; ``None`` for a new figure.

        Returns:
            The axes, one per panel.
        """
        from npdr_ppl.discovery.discovery_view import plot_discovery

        return plot_discovery(
            self.verdict, self.effects, self.search.rounds[-1].weights, self.gap, axes
        )

    def _repr_html_(self) -> str:
        from npdr_ppl.discovery.discovery_view import discovery_html

        return discovery_html(self.to_dict(), self.overlays.to_dict())

    def __repr__(self) -> str:
        found = ", ".join(
            f"{f.effect.name} ({f.probability:.0%})" if f.is_compared else f.effect.name
            for f in self.effects
        )
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
