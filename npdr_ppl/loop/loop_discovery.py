"""Discovery inside the NPDR loop: the model gets what the real rollouts so far say it lacks.

Discovery always begins at the model that the loop was given, never at an earlier revision: an
effect that was named from one short rollout has to prove itself again once there are more. What it
comes to is on disk before the loop goes on, and a resumed run reads it instead of searching again.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery import DiscoveryOptions, discover
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.handlers import ModelWithEffects, add_effect, with_finer_steps
from npdr_ppl.loop.loop_options import Model
from npdr_ppl.models.effects.registry import effect_class
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import read_json

__all__ = ["LoopDiscovery", "Revision", "effect_names"]

_LOGGER = logging.getLogger(__name__)

USUAL_REPORTS = 60
"""Sentences of a search of usual length, by which its progress is measured."""


@dataclass(frozen=True)
class Revision:
    """What looking for a missing effect came to.

    Attributes:
        model: The revised model; ``None`` where nothing is to be revised.
        reason: The finding in a sentence.
        parameters: Where the revised model fits best, by latent site.
        experiment: What to record next where causes could not be told apart, as
            ``discovery.json`` has it.
    """

    model: Model | None
    reason: str
    parameters: Mapping[str, Tensor] = field(default_factory=dict)
    experiment: Mapping[str, Any] | None = None


class LoopDiscovery:
    """Looks for what a model lacks in the real rollouts of a run.

    Args:
        model: The model that the loop was given.
        options: How to search.
        seed: Seed of everything random.
    """

    def __init__(self, model: Model, options: DiscoveryOptions, seed: int) -> None:
        self.model = model
        self.options = replace(options, seed=seed)

    def look(self, rollouts: Rollouts, folder: Path, progress: Step | None = None) -> Revision:
        """Returns the model with what was found, from disk if it has been looked for already.

        Args:
            rollouts: All real rollouts so far.
            folder: Where ``discovery.json`` and ``revised_model.py`` go.
            progress: Called with the fraction done and a short status.
        """
        file = folder / "discovery.json"
        if not file.exists():
            try:
                found = discover(
                    self.model,
                    rollouts,
                    options=self.options,
                    report=_reports(progress),
                )
            except NpdrError as error:
                # A rollout that ended early may be too short to tell anything by.
                _LOGGER.warning("Discovery: %s", error)
                return Revision(None, str(error))
            found.save(folder)
        return self._read(read_json(file))

    def _read(self, result: Mapping[str, Any]) -> Revision:
        """Returns the revision that a saved discovery stands for."""
        own = {effect.name: effect for effect in self.options.effects or ()}
        model = self.model
        for _ in range(result.get("finer_steps", 0)):
            model = with_finer_steps(model)
        for row in result["effects"]:
            name = f"{row['port']}.{row['effect']}"
            model = add_effect(model, own.get(name) or effect_class(row["effect"])(row["port"]))
        means = {name: row["mean"] for name, row in result["parameters"].items()}
        found = {name: torch.tensor(mean) for name, mean in means.items() if mean is not None}
        revised = None if model is self.model else model
        return Revision(revised, _sentence(result), found, result.get("next_experiment"))


def effect_names(model: Model) -> list[str]:
    """Returns the names of the effects that a model has beyond its own code."""
    attached = model.effects if isinstance(model, ModelWithEffects) else ()
    return [effect.name for effect, _ in attached]


def _sentence(result: Mapping[str, Any]) -> str:
    return f"{result['reason']} (Alarm: p = {result['alarm']['p_value']:.2g}.)"


def _reports(progress: Step | None) -> Callable[[str], None]:
    """Returns what turns discovery's sentences into progress; how many come, nobody knows."""
    count = 0

    def report(sentence: str) -> None:
        nonlocal count
        count += 1
        if progress is not None:
            progress(1.0 - 0.5 ** (4.0 * count / USUAL_REPORTS), sentence[:60])

    return report
