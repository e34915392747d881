"""Discovery inside the NPDR loop: adds the effects that the model lacks on the real rollouts.

Discovery always begins with the loop's original model, never with an earlier revision. An effect
that was found on one short rollout must be found again when there are more rollouts. The result is
saved before the loop continues, and a resumed run reads it instead of searching again.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery import DiscoveryOptions, discover
from npdr_ppl.discovery.search.settings import PRIOR_ENDS
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.handlers import (
    ModelWithEffects,
    add_effect,
    num_finer_steps,
    with_finer_steps,
)
from npdr_ppl.language.layers import layers
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import wider_sites, with_wider_priors
from npdr_ppl.models.effects.registry import effect_class
from npdr_ppl.posterior.run_folder import MAX_FINER_STEPS
from npdr_ppl.preparation.data_options import FEWEST_SEGMENTS, DataOptions
from npdr_ppl.progress import Reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import read_json, reading_back
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["LoopDiscovery", "Revision", "effect_names"]

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Revision:
    """The result of a search for missing effects.

    Attributes:
        model: The revised model; ``None`` if nothing is to be revised.
        reason: The finding in a sentence.
        parameters: The revised model's closest fit, by latent site.
        experiment: The next experiment, if causes could not be distinguished, in the form of
            ``discovery.json``.
    """

    model: Model | None
    reason: str
    parameters: Mapping[str, Tensor] = field(default_factory=dict)
    experiment: Mapping[str, Any] | None = None


class LoopDiscovery:
    """Searches the real rollouts of a run for effects that a model lacks.

    Args:
        model: The loop's original model.
        options: How the loop prepares rollouts. Discovery takes the precision from it, and the
            segment length if the rollouts are long enough; it estimates initial states and noise
            itself.
        search: Settings of the search.
        seed: Seed of all random numbers.
    """

    def __init__(
        self, model: Model, options: DataOptions, search: DiscoveryOptions, *, seed: int
    ) -> None:
        self.model = model
        self.options = replace(options, initial_state="uncertain", noise="auto")
        self.search = search
        self.seed = seed

    def look(
        self, rollouts: Rollouts, folder: Path, progress: bool | Reporter | None = False
    ) -> Revision:
        """Returns the model with the effects found, from disk if they were searched already.

        Args:
            rollouts: All real rollouts so far.
            folder: Folder for ``discovery.json`` and ``revised_model.py``.
            progress: Whether to show progress, or where.
        """
        file = folder / "discovery.json"
        if not file.exists():
            try:
                found = discover(
                    self.model,
                    rollouts,
                    options=self._options_for(rollouts),
                    search=self.search,
                    seed=self.seed,
                    progress=progress,
                )
            except NpdrError as error:
                # A rollout that ended early may be too short for a search.
                _LOGGER.warning("Discovery: %s", error)
                return Revision(None, str(error))
            found.save(folder)
        with reading_back(file):
            return self._read(read_json(file, DiscoveryRecord))

    def _options_for(self, rollouts: Rollouts) -> DataOptions:
        """Returns the loop's options, with segments of a length that discovery can use."""
        length = self.options.steps(rollouts)
        if length is not None and 2 <= length <= sum(rollouts.lengths) // FEWEST_SEGMENTS:
            return self.options
        return replace(self.options, segment_length="auto")

    def _read(self, result: Mapping[str, Any]) -> Revision:
        """Returns the revision that a saved discovery describes, with the priors of the search."""
        own = {effect.name: effect for effect in self.search.effects or ()}
        model = self.model
        # What the loop's own model has already is listed first.
        finer = result.get("finer_steps", 0) - num_finer_steps(model)
        for _ in range(min(finer, MAX_FINER_STEPS)):
            model = with_finer_steps(model)
        wider = result.get("wider_priors", [])[len(wider_sites(model)) :]
        for names in wider[: PRIOR_ENDS.most_widenings]:
            model = with_wider_priors(model, names)
        for row in result["effects"]:
            name = f"{row['port']}.{row['effect']}"
            model = add_effect(model, own.get(name) or effect_class(row["effect"])(row["port"]))
        means = {name: row["mean"] for name, row in result["parameters"].items()}
        found = {name: torch.tensor(mean) for name, mean in means.items() if mean is not None}
        revised = None if model is self.model else model
        return Revision(revised, _sentence(result), found, result.get("next_experiment"))


def effect_names(model: Model) -> list[str]:
    """Returns the names of the effects that a model has beyond its own code."""
    return [
        effect.name
        for layer in layers(model)
        if isinstance(layer, ModelWithEffects)
        for effect, _ in layer.effects
    ]


def _sentence(result: Mapping[str, Any]) -> str:
    return f"{result['reason']} (Alarm: p = {result['alarm']['p_value']:.2g}.)"
