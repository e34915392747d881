"""What this package wraps around Pyro models."""

from typing import Any

from npdr_ppl.language.model import Model

__all__ = ["Layer", "layers"]


class Layer:
    """A Pyro model that runs another one inside a handler.

    Attributes:
        base: The other model.
    """

    base: Model


def layers(model: Any) -> list[Any]:
    """Returns a model and the layers that are wrapped around it, the innermost first.

    Args:
        model: A Pyro model, possibly inside layers.
    """
    found = [model]
    while isinstance(found[0], Layer):
        found.insert(0, found[0].base)
    return found
