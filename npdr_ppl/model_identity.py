"""What a result depends on besides the data: a model's name, source and engine, and versions."""

import functools
import inspect
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pyro.poutine.messenger import Messenger

from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import ModelWithEffects, ModelWithFinerSteps
from npdr_ppl.language.layers import Layer
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.language.wider_priors import ModelWithWiderPriors
from npdr_ppl.python_files import class_file, is_importable

__all__ = [
    "engine_settings",
    "model_name",
    "source_text",
    "unwrapped",
    "versions",
]

_PACKAGES = ("npdr-ppl", "torch", "pyro-ppl", "zuko", "numpy", "arviz")


def versions() -> dict[str, str]:
    """Returns the versions that a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def model_name(model: Any) -> str:
    """Returns the name of a model with what is attached to it; the same in every process.

    A function called ``model`` has the name of its Python file: so are all models called that are
    derived from a robot's file, and their files have the robot's name.
    """
    if _is_wrapped(model):
        return model_name(model.args[-1])
    if isinstance(model, ModelWithEffects | ModelWithFinerSteps | ModelWithWiderPriors):
        return repr(model).replace(model.__name__, model_name(model.base), 1)
    name = getattr(model, "__name__", type(model).__name__)
    code = getattr(model, "__code__", None)
    file = Path("" if code is None else code.co_filename)
    return file.stem if name == "model" and file.suffix == ".py" and file.is_file() else name


def source_text(model: Any) -> str:
    """Returns the source of a model, and what is attached to it.

    Effects of this and other packages are named; of those from a user's own file, which may change
    between two runs, the file's text is returned, too.
    """
    if isinstance(model, ModelWithEffects):
        attached = "\n".join(f"# with {_described(e)}" for e, _ in model.effects)
        return f"{source_text(model.base)}\n{attached}"
    if _is_wrapped(model):
        return f"{source_text(model.args[-1])}\n# under {type(model.args[0]).__name__}"
    if isinstance(model, ModelWithFinerSteps | ModelWithWiderPriors):
        return f"{source_text(model.base)}\n# {model!r}"
    try:
        return inspect.getsource(model)
    except (OSError, TypeError):
        return repr(model)


def unwrapped(model: Any) -> tuple[Any, list[Effect]]:
    """Returns a model without layers and handlers, and the effects that were attached to it."""
    effects: list[Effect] = []
    while True:
        if _is_wrapped(model):
            model = model.args[-1]
        elif isinstance(model, Layer):
            own = model.effects if isinstance(model, ModelWithEffects) else ()
            effects = [*(effect for effect, _ in own), *effects]
            model = model.base
        else:
            return model, effects


def _described(effect: Effect) -> str:
    """Returns an effect's arguments, and the text of the user's file that defines it if any."""
    return f"{effect!r}{_own_file(effect)}"


def _own_file(effect: Effect) -> str:
    """Returns the text of the user's file that defines an effect; empty for those of packages."""
    file = None if is_importable(type(effect).__module__) else class_file(type(effect))
    return "" if file is None else f" of\n{file.read_bytes().decode(errors='replace')}"


def _is_wrapped(model: Any) -> bool:
    """Whether Pyro has wrapped a model in a handler: a partial that has both as arguments."""
    return (
        isinstance(model, functools.partial)
        and bool(model.args)
        and isinstance(model.args[0], Messenger)
    )


def engine_settings(prior: Prior) -> dict[str, Any]:
    """Returns the settings of the simulators' engines by site, without empty ones."""
    settings = {
        name: box.simulator.recorded_settings()
        for name, box in prior.black_boxes.items()
        if isinstance(box, SimulatorBlackBox)
    }
    return {name: values for name, values in settings.items() if values}
