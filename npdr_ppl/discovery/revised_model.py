"""The revised model as a Python file."""

import inspect
from collections.abc import Callable, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import pyro.distributions
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import ModelWithEffects, ModelWithFinerSteps, num_finer_steps
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import ModelWithWiderPriors

__all__ = ["revised_source"]

FUNCTION = "revised_model"


def revised_source(model: Model, effects: tuple[Effect, ...], fitted: Mapping[str, float]) -> str:
    """Returns Python source that defines ``revised_model``.

    A model from an installed module is imported. A model from a file is copied, so that the result
    needs no other file.

    Args:
        model: The original model.
        effects: The effects to add.
        fitted: Parameters of the closest fit by site, which the source lists for information.
    """
    base: Callable[..., Any] = model.base if isinstance(model, ModelWithEffects) else model
    present = [e for e, _ in model.effects] if isinstance(model, ModelWithEffects) else []
    every = [*present, *effects]
    num_finer = num_finer_steps(base)
    wider: list[str] = []
    while isinstance(base, ModelWithFinerSteps | ModelWithWiderPriors):
        if isinstance(base, ModelWithWiderPriors):
            wider.append(f"{FUNCTION} = with_wider_priors({FUNCTION}, {list(base.names)!r})")
        base = base.base
    head, name = _base(base)
    imports = sorted({f"from {type(e).__module__} import {type(e).__name__}" for e in every})
    handlers = [*(["add_effect"] if every else []), *(["with_finer_steps"] if num_finer else [])]
    handlers += ["with_wider_priors"] if wider else []
    if handlers:
        imports = [f"from npdr_ppl import {', '.join(handlers)}", *imports]
    if any(effect.given_priors for effect in every):
        imports = ["import pyro.distributions", "", *imports]
    lines = [head.rstrip(), "", "", *imports, "", f"{FUNCTION} = {name}"]
    lines += [f"{FUNCTION} = with_finer_steps({FUNCTION})"] * num_finer
    if wider:
        lines += ["# These priors did not contain the best parameters.", *reversed(wider)]
    for effect in every:
        lines += _added(effect)
    lines += ["", "# Parameters of the closest fit to the recording."]
    lines += ["CLOSEST_FIT = {"]
    lines += [f'    "{site}": {value:.6g},' for site, value in fitted.items()]
    return "\n".join([*lines, "}", ""])


def _added(effect: Effect) -> list[str]:
    """Returns the lines that add an effect, with the priors that its user gave it."""
    lines, priors = [], []
    for name, prior in effect.given_priors.items():
        written = _distribution(prior)
        if written is None:
            lines.append(f"# The prior given to {effect.name}.{name} has no source: put it here.")
        else:
            priors.append(f'    "{name}": {written},')
    made = repr(effect)
    if priors:
        lines += ["PRIORS = {", *priors, "}"]
        made = f"{made.removesuffix(')')}, priors=PRIORS)"
    return [*lines, f"{FUNCTION} = add_effect({FUNCTION}, {made})"]


def _distribution(prior: Distribution) -> str | None:
    """Returns a Pyro distribution as source, or ``None`` if it cannot be written so."""
    name = type(prior).__name__
    if getattr(pyro.distributions, name, None) is not type(prior):
        return None
    given = []
    for word in inspect.signature(type(prior)).parameters:
        value = getattr(prior, word, None)
        if isinstance(value, Tensor) and value.ndim == 0:
            given.append(f"{word}={value.item()!r}")
        elif word != "validate_args":
            return None
    return f"pyro.distributions.{name}({', '.join(given)})"


def _base(model: Model) -> tuple[str, str]:
    """Returns the source that defines a model, and the model's name."""
    module = inspect.getmodule(model)
    name = getattr(model, "__name__", type(model).__name__)
    if module is not None and _is_installed(module.__name__):
        doc = f'"""{name} with the effects that it was missing."""'
        return f"{doc}\n\nfrom {module.__name__} import {name}", name
    path = inspect.getsourcefile(model)
    if path is None:
        return f"# The source of {name} was not found: import it here.", name
    return Path(path).read_text(encoding="utf-8"), name


def _is_installed(module: str) -> bool:
    # importlib.util.find_spec would also find modules that were loaded from a file by path.
    return PathFinder.find_spec(module.partition(".")[0]) is not None
