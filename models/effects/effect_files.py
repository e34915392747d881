"""Effects that a user's own Python file defines."""

import inspect
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.effects import Effect
from npdr_ppl.python_files import own_names

__all__ = ["check_declared", "effect_of", "effects_of"]

_DECLARED = {"id": str, "port_kinds": tuple, "parameters": tuple}
"""What every effect declares, and of which type."""


def effects_of(module: ModuleType, path: Path) -> dict[str, type[Effect]]:
    """Returns the effects that a file defines, by the name of the class.

    Classes whose name begins with an underscore, and those that the file imports, are left out.

    Args:
        module: The file's module.
        path: The file, for messages.

    Raises:
        ModelError: There is none, or one lacks what every effect declares.
    """
    own = {name: getattr(module, name) for name in own_names(module) if name[0] != "_"}
    found = {
        name: value
        for name, value in own.items()
        if inspect.isclass(value) and issubclass(value, Effect)
    }
    if not found:
        classes = [name for name, value in own.items() if inspect.isclass(value)]
        has = f"it has {', '.join(classes)}" if classes else "it has no classes"
        raise ModelError(
            f"{path} has no effect, a subclass of ForceEffect, ActionEffect or another class of "
            f"npdr_ppl.language.effects; {has}."
        )
    for cls in found.values():
        check_declared(cls, path)
    return found


def effect_of(module: ModuleType, path: Path, name: str = "") -> type[Effect]:
    """Returns one effect of a file.

    Args:
        module: The file's module.
        path: The file, for messages.
        name: Name of the class; it may be empty if the file has one effect.

    Raises:
        ModelError: There is no such effect, or several without a name.
    """
    if not name:
        effects = effects_of(module, path)
        if len(effects) > 1:
            raise ModelError(
                f"{path} has the effects {', '.join(effects)}; say which, as in "
                f"{path}:{next(iter(effects))}@PORT."
            )
        return next(iter(effects.values()))
    found = getattr(module, name, None)
    if inspect.isclass(found) and issubclass(found, Effect):
        check_declared(found, path)
        return found
    if found is not None:
        raise ModelError(f"{path}:{name} is no effect, a subclass of npdr_ppl's class Effect.")
    known = effects_of(module, path)
    close = get_close_matches(name, known, n=1)
    hint = f"did you mean {path}:{close[0]}?" if close else f"it has {', '.join(known)}."
    raise ModelError(f"{path} has no class {name!r}; {hint}")


def check_declared(cls: type[Effect], path: Path) -> None:
    """Raises a ModelError if a class lacks what every effect declares.

    Args:
        cls: The class.
        path: Its file, for messages.
    """
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    missing += [
        name for name, kind in _DECLARED.items() if not isinstance(getattr(cls, name, None), kind)
    ]
    label = f"{cls.__name__} in {path}"
    if missing:
        raise ModelError(f"{label} does not define {', '.join(missing)}; every effect has to.")
    if not cls.id.isidentifier() or cls.id.startswith("_"):
        raise ModelError(
            f"{label} has the id {cls.id!r}; it may have letters, digits and underscores only, "
            "and begins with a letter."
        )
    if not cls.parameters or not all(isinstance(p, Parameter) for p in cls.parameters):
        raise ModelError(f"{label} has to list at least one Parameter in its parameters.")
