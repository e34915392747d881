"""The revised model as a Python file."""

import inspect
from collections.abc import Mapping
from importlib.machinery import PathFinder
from pathlib import Path

import pyro.distributions
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import ModelWithEffects, ModelWithFinerSteps, num_finer_steps
from npdr_ppl.language.layers import layers
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import ModelWithWiderPriors, wider_sites

__all__ = ["revised_source"]

FUNCTION = "revised_model"

LEARNED = "npdr_learned"
"""Module of learned effects, which exists only while they are learned."""


def revised_source(
    model: Model,
    effects: tuple[Effect, ...],
    fitted: Mapping[str, float],
    written: str = "",
) -> str:
    """Returns Python source that defines ``revised_model``.

    A model from an installed module is imported. A model from a file is copied, so that the result
    needs no other file.

    Args:
        model: The original model.
        effects: The effects to add.
        fitted: Parameters of the closest fit by site, which the source lists for information.
        written: Source of effects that no module has.
    """
    base, *handlers = layers(model)
    head, name = _base(base)
    every = [e for h in handlers if isinstance(h, ModelWithEffects) for e, _ in h.effects]
    every += effects
    own = [e for e in every if type(e).__module__ != LEARNED]
    imports = sorted({f"from {type(e).__module__} import {type(e).__name__}" for e in own})
    functions = [
        *(["add_effect"] if every else []),
        *(["with_finer_steps"] if num_finer_steps(model) else []),
        *(["with_wider_priors"] if wider_sites(model) else []),
    ]
    if functions:
        imports = [f"from npdr_ppl import {', '.join(functions)}", *imports]
    if any(effect.given_priors for effect in every):
        imports = ["import pyro.distributions", "", *imports]
    lines = [head.rstrip(), "", "", *imports, ""]
    if written:
        lines += [written.strip(), "", ""]
    lines += [f"{FUNCTION} = {name}"]
    for handler in handlers:
        lines += _handled(handler)
    for effect in effects:
        lines += _added(effect)
    lines += ["", "# Parameters of the closest fit to the recording."]
    lines += ["CLOSEST_FIT = {"]
    lines += [f'    "{site}": {value:.6g},' for site, value in fitted.items()]
    return "\n".join([*lines, "}", ""])


def _handled(handler: ModelWithEffects | ModelWithFinerSteps | ModelWithWiderPriors) -> list[str]:
    """Returns the lines that put a model into a handler."""
    if isinstance(handler, ModelWithEffects):
        return [line for effect, _ in handler.effects for line in _added(effect)]
    if isinstance(handler, ModelWithFinerSteps):
        return [f"{FUNCTION} = with_finer_steps({FUNCTION})"]
    return [
        "# These priors did not contain the best parameters.",
        f"{FUNCTION} = with_wider_priors({FUNCTION}, {list(handler.names)!r})",
    ]


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
