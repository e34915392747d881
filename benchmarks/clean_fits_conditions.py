"""What is special about a recording or the model it is fitted by.

Under ``clean`` and ``backends`` nothing is. Under ``narrow`` one prior ends before the truth, so
far that no other parameters make up for it. Under ``friction``, ``weak_friction`` and ``missing``
the rig has an effect that the model lacks.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from clean_fits_rigs import (
    RIG_SUBJECTS,
    RigSubject,
    drawn_parameters,
    prior_ranges,
    record_rig,
    simulator_of,
)
from clean_fits_separation import separation
from clean_fits_subjects import HOLDOUT, SUBJECTS, Recorded, recorded
from hidden_rigs import Hidden
from hidden_rigs.rig import Place
from hidden_rigs.sizes import drawn

from npdr_ppl.errors import DataError
from npdr_ppl.randomness import derived_seed

__all__ = ["BACKENDS", "CONDITIONS", "SEPARATION", "made", "subjects_of", "variants_of"]

BACKENDS = ("snpe-c", "snpe-a", "nle", "nre", "bayessim", "bayesian-linear-regression")
"""Backends that ``backends`` compares, each with the defaults of its command."""

CONDITIONS = ("clean", "backends", "narrow", "friction", "weak_friction", "missing")
"""All conditions."""

SEPARATION = 30.0
"""Least separation d of what the true model explains and the given one cannot."""

WEAKEST = 2.0
"""Multiple of the least separation that a weak effect has at most."""

FITTED = tuple(range(HOLDOUT))

FIRST_GAP, WIDER, LEAST_WIDTH = 0.1, 1.5, 0.15
"""Distance of a prior's end from the truth that is tried first, the factor between tries, and the
least width that remains: shares of the zoo's prior."""

TRIES = 6
"""How many strengths of an effect are tried: the last is 32 times its typical size, beyond which
no rig of this kind is."""


def variants_of(condition: str) -> tuple[str, ...]:
    """Returns the variants of a condition: the backends, or one without a name."""
    return BACKENDS if condition == "backends" else ("",)


def subjects_of(condition: str) -> tuple[str, ...]:
    """Returns the subjects for which there is a condition."""
    return SUBJECTS if condition == "clean" else tuple(RIG_SUBJECTS)


def made(subject: str, condition: str, seed: int) -> Recorded:
    """Records a subject under a condition.

    Raises:
        DataError: No seed like this has what the condition asks for.
        ValueError: There is no such condition.
    """
    if condition in ("clean", "backends"):
        return recorded(subject, seed)
    rig = RIG_SUBJECTS[subject]
    if condition == "narrow":
        return _narrowed(rig, seed)
    if condition in ("friction", "weak_friction"):
        return _with_effect(rig, (rig.rig.layout.joints[0], "coulomb_friction"), condition, seed)
    if condition == "missing":
        generator = np.random.default_rng(derived_seed(seed, subject, "missing effect"))
        places = rig.rig.effects
        return _with_effect(rig, places[int(generator.integers(len(places)))], condition, seed)
    raise ValueError(f"There is no condition {condition!r}; there are {', '.join(CONDITIONS)}.")


def _narrowed(subject: RigSubject, seed: int) -> Recorded:
    """Returns a clean recording, and a model whose prior excludes one true parameter.

    The parameter is drawn; it is another one where the recording hardly informs it.
    """
    clean = recorded(subject.model, seed)
    noise_free = record_rig(subject, clean.truth, seed=seed, is_noisy=False)
    generator = np.random.default_rng(derived_seed(seed, subject.model, "narrow prior"))
    for name in generator.permutation(list(clean.truth)).tolist():
        gap = FIRST_GAP
        while (ends := _cut(clean.prior[name], clean.truth[name], gap)) is not None:
            prior = {**clean.prior, name: ends}
            d = separation(subject.rig, noise_free, clean.truth, prior, FITTED)
            if d >= SEPARATION:
                return replace(
                    clean,
                    prior=prior,
                    source=own_model(subject.model, prior),
                    notes={"narrowed": name, "separation": d},
                )
            gap *= WIDER
    raise DataError(f"No prior of {subject.model} can be narrowed so that it shows, seed {seed}.")


def _cut(ends: tuple[float, float], truth: float, gap: float) -> tuple[float, float] | None:
    """Returns a prior that ends before the truth, on its wider side; ``None`` if little is left.

    Args:
        ends: Ends of the zoo's prior.
        truth: The true value.
        gap: Distance of the new end from the truth, as a share of the prior's width.
    """
    low, high = ends
    width = high - low
    if truth - low >= high - truth:
        cut = (low, truth - gap * width)
    else:
        cut = (truth + gap * width, high)
    return cut if cut[1] - cut[0] >= LEAST_WIDTH * width else None


def own_model(model: str, prior: Mapping[str, tuple[float, float]]) -> str:
    """Returns a file with the simulator of a model of the zoo under other uniform priors."""
    kind = type(simulator_of(model))
    sites = [
        f'        "{name}": pyro.sample("{name}", dist.Uniform({low!r}, {high!r})),'
        for name, (low, high) in prior.items()
    ]
    return "\n".join(
        [
            f'"""The simulator of {model} under priors of its owner."""',
            "",
            "import pyro",
            "import pyro.distributions as dist",
            "",
            "import npdr_ppl as npdr",
            f"from {inspect.getmodule(kind).__name__} import {kind.__name__}",
            "",
            "",
            "def model(inputs):",
            "    parameters = {",
            *sites,
            "    }",
            f'    return npdr.simulate("trajectory", {kind.__name__}(), parameters, inputs)',
            "",
        ]
    )


def _with_effect(subject: RigSubject, place: Place, condition: str, seed: int) -> Recorded:
    """Returns a recording of a rig with an effect that its model lacks."""
    truth, prior = drawn_parameters(subject, seed), prior_ranges(subject.model)
    port, effect_id = place

    def of(strength: float) -> Hidden:
        generator = np.random.default_rng(derived_seed(seed, subject.model, *place))
        return drawn(subject.rig.port(port), effect_id, strength, generator)

    strength, d = _strength(subject, of, truth, is_weak=condition == "weak_friction", seed=seed)
    hidden = of(strength)
    rollouts = record_rig(subject, truth, seed=seed, hidden=(hidden,)).rollouts
    notes = {"hidden": hidden.name, "separation": d, "strength": strength}
    return Recorded(subject.model, rollouts, truth, prior, notes=notes)


def _strength(
    subject: RigSubject,
    of: Callable[[float], Hidden],
    truth: Mapping[str, float],
    *,
    is_weak: bool,
    seed: int,
) -> tuple[float, float]:
    """Returns a multiple of an effect's typical size, and the separation that it has.

    Args:
        subject: The rig.
        of: Returns the effect of some strength.
        truth: True parameters.
        is_weak: Whether the separation is to be little more than the least.
        seed: Seed of the recording.

    Raises:
        DataError: No strength that was tried separates as far.
    """
    prior, strength = prior_ranges(subject.model), 1.0
    for _ in range(TRIES):
        recording = record_rig(subject, truth, seed=seed, hidden=(of(strength),), is_noisy=False)
        d = separation(subject.rig, recording, truth, prior, FITTED)
        is_little = d <= WEAKEST * SEPARATION or not is_weak
        if d >= SEPARATION and is_little:
            return strength, d
        if is_weak and d > 0.0:
            strength *= min(4.0, max(0.02, math.sqrt(WEAKEST) * SEPARATION / d))
        else:
            strength *= 2.0
    raise DataError(
        f"No strength of {of(1.0).name} separates {subject.model} by {SEPARATION:g}, seed {seed}."
    )
