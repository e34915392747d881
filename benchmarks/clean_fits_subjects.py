"""What is fitted: recordings, their truth, and the model that a user would name.

Every subject is recorded into a folder of its own: ``rec.csv`` and ``truth.json``.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from clean_fits_environments import ENVIRONMENTS, record_environment
from clean_fits_rigs import (
    DURATION,
    RIG_SUBJECTS,
    drawn_parameters,
    prior_ranges,
    record_rig,
)

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

__all__ = ["HOLDOUT", "MODELS", "SUBJECTS", "Recorded", "recorded"]

MODELS = Path(__file__).parent / "clean_fits_models"
"""Folder of the models that are not the zoo's."""

HOLDOUT = 3
"""Index of the held-out rollout, the last of four."""

GIVEN_PENDULUM = {"mass": 1.1, "length": 0.9}
"""A pendulum of everyday size, in kg and m, under changing excitations and noise."""

THROW_NOISE = 0.02
"""Standard deviation of the readings of a throw, in m; the recipe declares the same."""

SUBJECTS = (
    *RIG_SUBJECTS,
    "given_pendulum",
    *ENVIRONMENTS,
    "quick_start",
    "throw",
)
"""All subjects: the zoo's models by name, one pendulum of given mass and length, Gymnasium's
environments, the quick start's recipe on data from its own model, and a plain function."""


@dataclass(frozen=True)
class Recorded:
    """A recording with its truth.

    Attributes:
        model: The word that names the model on the command line; for a recipe, the recipe.
        rollouts: All four rollouts; ``None`` for a plain function.
        truth: True values of what the model infers.
        prior: Ends of their uniform priors.
        is_recipe: Whether a Python program is run instead of the command line.
        observation: What a plain function's model observes.
        source: Text of the model's own file; empty where the model is named by a word.
        notes: What else is to be known of the recording.
    """

    model: str
    rollouts: Rollouts | None
    truth: Mapping[str, float]
    prior: Mapping[str, tuple[float, float]]
    is_recipe: bool = False
    observation: tuple[float, ...] = ()
    source: str = ""
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def replayed_in(self) -> str:
        """Word that names a model in which the truth can be replayed."""
        return "pendulum" if self.is_recipe else self.model

    def word(self, folder: Path) -> str:
        """Returns what names the model on the command line, written to a folder."""
        return f"{folder / 'model.py'}:model" if self.source else self.model

    def write(self, folder: Path) -> None:
        """Writes ``rec.csv`` and ``truth.json``, and ``model.py`` if the model has a file.

        A recipe that holds nothing out is given the rollouts to fit alone.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if self.rollouts is not None:
            given = self.rollouts[:HOLDOUT] if self.is_recipe else self.rollouts
            given.to_csv(folder / "rec.csv")
        content: dict[str, Any] = {
            "model": self.model,
            "parameters": dict(self.truth),
            "prior": {name: list(ends) for name, ends in self.prior.items()},
            "observation": list(self.observation),
            **self.notes,
        }
        if self.source:
            (folder / "model.py").write_text(self.source)
        (folder / "truth.json").write_text(json.dumps(content, indent=2) + "\n")


def recorded(subject: str, seed: int) -> Recorded:
    """Records a subject; the seed alone decides truth, excitation and noise."""
    if subject in RIG_SUBJECTS:
        rig = RIG_SUBJECTS[subject]
        truth = drawn_parameters(rig, seed)
        rollouts = record_rig(rig, truth, seed=seed).rollouts
        return Recorded(subject, rollouts, truth, prior_ranges(subject))
    if subject == "given_pendulum":
        rig = RIG_SUBJECTS["pendulum"]
        rollouts = record_rig(rig, GIVEN_PENDULUM, seed=derived_seed(seed, subject)).rollouts
        return Recorded("pendulum", rollouts, GIVEN_PENDULUM, prior_ranges("pendulum"))
    if subject in ENVIRONMENTS:
        prior = ENVIRONMENTS[subject].prior
        truth = _drawn(prior, seed, subject)
        rollouts = record_environment(subject, truth, seed=seed)
        return Recorded(f"{MODELS / subject}.py:model", rollouts, truth, prior)
    if subject == "quick_start":
        prior = prior_ranges("pendulum")
        truth = _drawn(prior, seed, subject)
        return Recorded(subject, _simulated_pendulum(truth, seed), truth, prior, is_recipe=True)
    if subject == "throw":
        return _throw(seed)
    raise ValueError(f"There is no subject {subject!r}; there are {', '.join(SUBJECTS)}.")


def _drawn(prior: Mapping[str, tuple[float, float]], seed: int, subject: str) -> dict[str, float]:
    generator = np.random.default_rng(derived_seed(seed, subject, "clean parameters"))
    return {name: float(generator.uniform(*ends)) for name, ends in prior.items()}


def _simulated_pendulum(truth: Mapping[str, float], seed: int) -> Rollouts:
    """Returns rollouts of the zoo's own simulator, with the noise that the quick start declares.

    The commands and starts are those of the rig of the same seed: they keep such a pendulum
    within its limits.
    """
    driven = record_rig(RIG_SUBJECTS["pendulum"], truth, seed=seed).rollouts
    generator = np.random.default_rng(derived_seed(seed, "quick start", "noise"))
    simulator = Pendulum()
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in truth.items()}
    readings = []
    for start, actions in zip(driven.readings, driven.actions, strict=True):
        inputs = Inputs.single(
            torch.tensor(actions),
            torch.tensor(start[0]),
            action_names=driven.action_names,
            state_names=driven.channel_names,
            time_step=driven.time_step,
        )
        after = simulator.simulate(values, inputs)[0].numpy()
        states = np.concatenate((start[:1], after))
        readings.append(states + generator.standard_normal(states.shape) * np.array([0.02, 0.1]))
    assert len(readings[0]) == round(DURATION / driven.time_step) + 1
    return Rollouts.from_arrays(
        readings,
        list(driven.actions),
        channel_names=driven.channel_names,
        action_names=driven.action_names,
        time_step=driven.time_step,
        channel_units=driven.channel_units,
        action_units=driven.action_units,
    )


def _throw(seed: int) -> Recorded:
    """Returns range and height of a throw, as the page on simulators has it, with noise."""
    prior = {"speed": (1.0, 10.0), "angle": (0.2, 1.4)}  # m/s, rad
    truth = _drawn(prior, seed, "throw")
    across = truth["speed"] * math.cos(truth["angle"])
    up = truth["speed"] * math.sin(truth["angle"])
    generator = np.random.default_rng(derived_seed(seed, "throw", "noise"))
    clean = np.array([2.0 * across * up / 9.81, up**2 / (2.0 * 9.81)])
    observation = clean + THROW_NOISE * generator.standard_normal(2)
    return Recorded(
        "throw", None, truth, prior, is_recipe=True, observation=tuple(observation.tolist())
    )
