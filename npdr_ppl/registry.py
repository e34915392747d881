"""Base of the registries of exchangeable methods: classes by name, loaded at first use."""

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
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
        group: Entry points by which other packages add classes; built-in names cannot be taken.
        built_in: ``module:class`` of the classes of this package by name.
    """

    kind: str
    base: type[T]
    error: type[NpdrError]
    group: str
    built_in: Mapping[str, str]

    def locations(self) -> dict[str, str]:
        """Returns ``module:class`` of each by name, the built-in ones first."""
        added = {entry.name: entry.value for entry in entry_points(group=self.group)}
        return {**self.built_in, **added, **self.built_in}

    def find(self, name: str, locations: Mapping[str, str] | None = None) -> type[T]:
        """Returns the class called ``name``.

        Args:
            name: Name of the class; an unknown or broken one raises ``error``.
            locations: The result of :meth:`locations`, if it was read before.
        """
        locations = self.locations() if locations is None else locations
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

    def summaries(self) -> dict[str, str]:
        """Returns the ``summary`` of each class by name, in alphabetical order."""
        locations: Any = self.locations()
        found: dict[str, Any] = {name: self.find(name, locations) for name in sorted(locations)}
        return {name: cls.summary for name, cls in found.items()}

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
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known) or 'none'}."
