"""Turns words on the command line into models, effects and data."""

import importlib.util
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from npdr_ppl.errors import DataError, ModelError

__all__ = ["resolve_effects", "resolve_model", "resolve_rollouts"]


def resolve_model(word: str) -> Callable[..., Any]:
    """Returns the model that ``MODEL`` names: a zoo name, or ``path/to/file.py:function``.

    Raises:
        ModelError: There is no such model.
    """
    from npdr_ppl.models import zoo

    entries = zoo()
    if word in entries:
        return entries[word].model
    path, separator, function = word.rpartition(":")
    if not separator or not path.endswith(".py"):
        close = get_close_matches(word, entries, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"the zoo has {', '.join(entries)}."
        raise ModelError(
            f"{word!r} is neither a model of the zoo nor path/to/file.py:function; {hint}"
        )
    return _load_function(Path(path), function)


def _load_function(path: Path, function: str) -> Callable[..., Any]:
    if not path.is_file():
        raise ModelError(f"{path} does not exist.")
    # Under a name of its own: a file called json.py must not take the library's place.
    name = f"_npdr_model_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ModelError(f"{path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(f"{path} cannot be loaded: {type(error).__name__}: {error}.") from error
    model = getattr(module, function, None)
    if not callable(model):
        raise ModelError(f"{path} has no function {function!r}.")
    return model


def resolve_effects(model: Callable[..., Any], words: Sequence[str]) -> Callable[..., Any]:
    """Attaches effects given as ``port.effect``, e.g. ``pole.coulomb_friction``.

    Raises:
        ModelError: There is no such effect.
    """
    from npdr_ppl.language.handlers import add_effect
    from npdr_ppl.models.effects import effects

    catalogue = effects()
    for word in words:
        port, separator, name = word.rpartition(".")
        if not separator or name not in catalogue:
            close = get_close_matches(name, catalogue, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(catalogue)}."
            raise ModelError(
                f"{word!r} is not port.effect with an effect of the catalogue; {hint}"
            )
        model = add_effect(model, catalogue[name](port))
    return model


def resolve_rollouts(path: Path, holdout: str = "") -> tuple[Any, Any]:
    """Loads rollouts and splits off the held-out ones.

    Args:
        path: CSV, Parquet, NPZ or NetCDF.
        holdout: Positions of held-out rollouts, e.g. ``"3,4"``.

    Returns:
        Rollouts to fit, and held-out rollouts or ``None``.

    Raises:
        DataError: The file is bad, or a position does not exist.
    """
    from npdr_ppl.rollouts import Rollouts

    rollouts = Rollouts.load(path)
    if not holdout:
        return rollouts, None
    try:
        test = sorted({int(part) for part in holdout.split(",")})
    except ValueError:
        raise DataError(f"--holdout takes positions such as 3,4; got {holdout!r}.") from None
    if test[0] < 0 or test[-1] >= len(rollouts) or len(test) == len(rollouts):
        raise DataError(
            f"--holdout {holdout} does not leave rollouts to fit: {path} has {len(rollouts)}, "
            "counted from 0."
        )
    train = [i for i in range(len(rollouts)) if i not in test]
    return rollouts[train], rollouts[test]
