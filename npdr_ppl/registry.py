"""Base of the registries of exchangeable methods: classes by name, loaded at first use."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Generic, TypeVar

from npdr_ppl.errors import NpdrError

__all__ = ["Registry", "hint"]

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Classes of one kind by name.

    Attributes:
        kind: Word for the classes in messages, e.g. ``"backend"``.
        base: Common base class.
        error: Error for a wrong name, class or option.
        locations: Returns ``module:class`` of each by name.
    """

    kind: str
    base: type[T]
    error: type[NpdrError]
    locations: Callable[[], Mapping[str, str]]

    def find(self, name: str) -> type[T]:
        """Returns the class called ``name``; raises ``error`` if it is unknown or broken."""
        locations = self.locations()
        if name not in locations:
            known = hint(name.lower().replace("_", "-"), locations)
            raise self.error(f"There is no {self.kind} {name!r}; {known}")
        label = f"{self.kind.capitalize()} {name!r}"
        module, _, attribute = locations[name].partition(":")
        try:
            loaded = getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise self.error(
                f"{label} cannot be loaded from {locations[name]}: {error}"
            ) from error
        if not (isinstance(loaded, type) and issubclass(loaded, self.base)):
            raise self.error(
                f"{label}: {locations[name]} is not a subclass of {self.base.__name__}."
            )
        return loaded

    def make(self, name: str, options: Mapping[str, Any]) -> T:
        """Returns an instance of the class called ``name``.

        Args:
            name: Name of the class in the registry.
            options: Arguments of its constructor; an unknown one raises ``error``.
        """
        cls = self.find(name)
        known = inspect.signature(cls).parameters
        for option in options:
            if option not in known:
                raise self.error(
                    f"{self.kind.capitalize()} {name!r} has no option {option!r}; "
                    f"{hint(option, known)}"
                )
        return cls(**options)


def hint(word: str, known: Iterable[str]) -> str:
    """Returns a hint with the most similar known word, or with all known words."""
    known = list(known)
    close = get_close_matches(word, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}."
