"""The revised model as a Python file."""

import inspect
from collections.abc import Mapping
from pathlib import Path

from torch.distributions import Distribution

from npdr_ppl.excerpts import import_lines
from npdr_ppl.language.effect_sources import sources_of
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import ModelWithEffects, ModelWithFinerSteps, num_finer_steps
from npdr_ppl.language.layers import layers
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import ModelWithWiderPriors, wider_sites
from npdr_ppl.language.written_priors import written_prior
from npdr_ppl.model_code import code_of
from npdr_ppl.python_files import is_importable
from npdr_ppl.python_text import plain, quoted

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

    What an installed module defines is imported. A model from a file is copied, and so is what an
    effect from a file needs of it, so that the result needs no other file. Only a model that needs
    the files beside its own is loaded from where it is.

    Args:
        model: The original model.
        effects: The effects to add.
        fitted: Parameters of the closest fit by site, which the source lists for information.
        written: Source of effects that no module has.
    """
    base, *handlers = layers(model)
    head, name, home = _base(base)
    every = [e for h in handlers if isinstance(h, ModelWithEffects) for e, _ in h.effects]
    every += effects
    needed = {
        "add_effect": bool(every),
        "with_finer_steps": num_finer_steps(model) > 0,
        "with_wider_priors": bool(wider_sites(model)),
    }
    imports = {
        f"from npdr_ppl import {function}" for function, is_used in needed.items() if is_used
    }
    if any(effect.given_priors for effect in every):
        imports.add("import pyro.distributions")
    own = [type(effect) for effect in every if type(effect).__module__ != LEARNED]
    sources = sources_of(own, head, home, imports)
    lines = [sources.head.rstrip(), "", "", *import_lines(sources.imports), *sources.blocks]
    blocks = ["", "", written.strip()] if written else []
    lines += [*blocks, "", *([""] if sources.blocks or written else []), f"{FUNCTION} = {name}"]
    for handler in handlers:
        lines += _handled(handler, sources.names)
    for effect in effects:
        lines += _added(effect, sources.names)
    lines += ["", "# Parameters of the closest fit to the recording."]
    lines += ["CLOSEST_FIT = {"]
    lines += [f"    {quoted(site)}: {value:.6g}," for site, value in fitted.items()]
    return "\n".join([*lines, "}", ""])


def _handled(
    handler: ModelWithEffects | ModelWithFinerSteps | ModelWithWiderPriors,
    names: Mapping[type[Effect], str],
) -> list[str]:
    """Returns the lines that put a model into a handler."""
    if isinstance(handler, ModelWithEffects):
        return [line for effect, _ in handler.effects for line in _added(effect, names)]
    if isinstance(handler, ModelWithFinerSteps):
        return [f"{FUNCTION} = with_finer_steps({FUNCTION})"]
    return [
        "# These priors did not contain the best parameters.",
        f"{FUNCTION} = with_wider_priors({FUNCTION}, {list(handler.names)!r})",
    ]


def _added(effect: Effect, names: Mapping[type[Effect], str]) -> list[str]:
    """Returns the lines that add an effect, with the priors that its user gave it.

    Args:
        effect: The effect.
        names: Names of the classes in the source.
    """
    lines, priors = [], []
    for name, prior in effect.given_priors.items():
        written = _distribution(prior)
        if written is None:
            site = plain(f"{effect.name}.{name}")
            lines.append(f"# The prior given to {site} has no source: put it here.")
        else:
            priors.append(f'    "{name}": {written},')
    own, shown = names.get(type(effect), type(effect).__name__), repr(effect)
    is_usual = shown.startswith(f"{type(effect).__name__}(")
    made = f"{own}({shown.partition('(')[2] if is_usual else f'port={effect.port!r})'}"
    if priors:
        lines += ["PRIORS = {", *priors, "}"]
        made = f"{made.removesuffix(')')}, priors=PRIORS)"
    return [*lines, f"{FUNCTION} = add_effect({FUNCTION}, {made})"]


def _distribution(prior: Distribution) -> str | None:
    """Returns a Pyro distribution as source, or ``None`` if it cannot be written so."""
    written = written_prior(prior)
    if written is None:
        return None
    name = written.pop("distribution")
    given = ", ".join(f"{word}={value!r}" for word, value in written.items())
    return f"pyro.distributions.{name}({given})"


def _base(model: Model) -> tuple[str, str, Path | None]:
    """Returns the source that defines a model, the model's name, and the file that is copied."""
    module, code = inspect.getmodule(model), code_of(model)
    name = code.name or getattr(model, "__name__", type(model).__name__)
    doc = f'"""{name} with the effects that it was missing."""'
    is_there = module is not None and code.file in (
        None,
        Path(getattr(module, "__file__", None) or ""),
    )
    if module is not None and is_there and is_importable(module.__name__):
        return f"{doc}\n\nfrom {module.__name__} import {name}", name, None
    if code.file is None:
        return f"# The source of {name} was not found: import it here.", name, None
    if code.is_alone:
        return code.file.read_text(encoding="utf-8"), name, code.file
    lines = [
        doc,
        "",
        "from pathlib import Path",
        "",
        "from npdr_ppl.cli.model_files import load_function",
        "",
        "# The model needs files beside its own, so it is loaded from where it is.",
        f"{name} = load_function(Path({quoted(str(code.file.absolute()))}), {quoted(name)})",
    ]
    return "\n".join(lines), name, None
