"""The registry of inference backends.

Other packages add theirs by an entry point of group ``npdr_ppl.backends``: its name selects the
backend, its value is a subclass of :class:`~npdr_ppl.inference.base.Backend`.
"""

import inspect
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend

__all__ = ["backend", "backend_class", "backends"]

GROUP = "npdr_ppl.backends"

BUILT_IN = {
    "abc": "npdr_ppl.inference.abc:ABC",
    "bayesian-linear-regression": (
        "npdr_ppl.inference.bayesian_linear_regression:BayesianLinearRegression"
    ),
    "bayessim": "npdr_ppl.inference.bayessim:BayesSim",
    "fmpe": "npdr_ppl.inference.fmpe:FMPE",
    "nle": "npdr_ppl.inference.nle:NLE",
    "nre": "npdr_ppl.inference.nre:NRE",
    "nuts": "npdr_ppl.inference.nuts:NUTS",
    "online-bayessim": "npdr_ppl.inference.online_bayessim:OnlineBayesSim",
    "snpe-a": "npdr_ppl.inference.snpe_a:SNPEA",
    "snpe-c": "npdr_ppl.inference.snpe_c:SNPEC",
}
"""Backends of this package by name; each is imported when it is asked for."""


def _locations() -> dict[str, str]:
    """Returns ``module:class`` of every backend by name; built-in names cannot be taken."""
    return {entry.name: entry.value for entry in entry_points(group=GROUP)} | BUILT_IN


def backend_class(name: str) -> type[Backend]:
    """Returns the class of a backend.

    Args:
        name: Word that selects it, e.g. ``"snpe-c"``.

    Raises:
        BackendError: There is no such backend, or it cannot be loaded.
    """
    locations = _locations()
    if name not in locations:
        close = get_close_matches(name.lower().replace("_", "-"), locations, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(locations)}."
        raise BackendError(f"There is no backend {name!r}; {hint}")
    module, _, attribute = locations[name].partition(":")
    try:
        loaded = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise BackendError(
            f"Backend {name!r} cannot be loaded from {locations[name]}: {error}"
        ) from error
    if not (isinstance(loaded, type) and issubclass(loaded, Backend)):
        raise BackendError(f"Backend {name!r}: {locations[name]} is not a subclass of Backend.")
    return loaded


def backend(name: str, **options: Any) -> Backend:
    """Makes a backend.

    Args:
        name: Word that selects it.
        options: Arguments of its constructor.

    Raises:
        BackendError: There is no such backend, or it has no such option.
    """
    cls = backend_class(name)
    known = inspect.signature(cls).parameters
    for option in options:
        if option not in known:
            close = get_close_matches(option, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}."
            raise BackendError(f"Backend {name!r} has no option {option!r}; {hint}")
    return cls(**options)


def backends() -> dict[str, str]:
    """Returns every backend's one-line summary by name, in alphabetical order."""
    return {name: backend_class(name).summary for name in sorted(_locations())}
