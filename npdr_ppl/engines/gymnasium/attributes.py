"""Paths to values in an environment's attributes: ``"mass"``, ``"model.opt.gravity[2]"``."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter

__all__ = ["Attribute", "Path"]

_PART = re.compile(r"\.?([A-Za-z_]\w*)|\[(-?\d+(?:\s*,\s*-?\d+)*)\]")


@dataclass(frozen=True)
class Path:
    """Path to a value in an object: names separated by dots, indices in brackets.

    Attributes:
        text: The path.
    """

    text: str

    def __post_init__(self) -> None:
        """Checks the form.

        Raises:
            ModelError: The text is not such a path.
        """
        if not self.text or self.text[0] in ".[" or _PART.sub("", self.text):
            raise ModelError(
                f"{self.text!r} is no path of attributes; write 'mass' or 'model.opt.gravity[2]'."
            )

    @cached_property
    def _parts(self) -> tuple[str | int | tuple[int, ...], ...]:
        parts: list[str | int | tuple[int, ...]] = []
        for name, entry in _PART.findall(self.text):
            numbers = tuple(int(number) for number in entry.split(",") if number.strip())
            parts.append(name or (numbers[0] if len(numbers) == 1 else numbers))
        return tuple(parts)

    def get(self, root: Any) -> Any:
        """Returns the value at the path.

        Raises:
            ModelError: The path does not exist.
        """
        for part in self._parts:
            root = self._next(root, part)
        return root

    def getter(self) -> Callable[[Any], Any]:
        """Returns a faster form of :meth:`get`, for a path that is known to exist."""
        return attrgetter(self.text) if "[" not in self.text else self.get

    def set(self, root: Any, value: Any) -> None:
        """Sets the value at the path.

        Raises:
            ModelError: The path does not exist.
        """
        *way, last = self._parts
        for part in way:
            root = self._next(root, part)
        if isinstance(last, str):
            setattr(root, last, value)
        else:
            root[last] = value

    def _next(self, root: Any, part: str | int | tuple[int, ...]) -> Any:
        try:
            return getattr(root, part) if isinstance(part, str) else root[part]
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ModelError(
                f"The environment has nothing at {self.text!r}: {type(root).__name__} has no "
                f"{part!r}."
            ) from error


@dataclass(frozen=True)
class Attribute:
    """A number in an environment's attributes, as a domain parameter.

    Attributes:
        path: Its path in the unwrapped environment, e.g. ``"m"`` or ``"model.body_mass[1]"``.
        unit: SI unit.
        description: Short description for tables.
    """

    path: str
    unit: str = "1"
    description: str = ""

    def parameter(self, name: str, environment: Any) -> Parameter:
        """Returns the declaration; the environment's own value is the nominal one.

        Raises:
            ModelError: There is no number at the path.
        """
        value = Path(self.path).get(environment)
        if np.ndim(value) or not isinstance(value, int | float | np.number):
            raise ModelError(
                f"The parameter {name!r} is a number, but {self.path!r} of the environment is "
                f"{value!r}."
            )
        return Parameter(name, self.unit, float(value), self.description or self.path)


def vector(value: Any) -> NDArray[np.float64]:
    """Returns numbers as a flat copy, because environments may reuse their arrays."""
    copied = np.array(value, dtype=np.float64)
    return copied if copied.ndim == 1 else copied.reshape(-1)
