"""The registry of inference backends.

Other packages add theirs by an entry point of group ``npdr_ppl.backends``: its name selects the
backend, its value is a subclass of :class:`~npdr_ppl.inference.base.Backend`.
"""

from typing import Any

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend
from npdr_ppl.registry import Registry

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
"""Backends of this package by name; each is imported on first use."""


_REGISTRY = Registry("backend", Backend, BackendError, GROUP, BUILT_IN)


def backend_class(name: str) -> type[Backend]:
    """Returns the class of a backend.

    Args:
        name: Word that selects it, e.g. ``"snpe-c"``.

    Raises:
        BackendError: There is no such backend, or it cannot be loaded.
    """
    return _REGISTRY.find(name)


def backend(name: str, **options: Any) -> Backend:
    """Makes a backend.

    Args:
        name: Word that selects it.
        options: Arguments of its constructor.

    Raises:
        BackendError: There is no such backend, or it has no such option.
    """
    return _REGISTRY.make(name, options)


def backends() -> dict[str, str]:
    """Returns every backend's one-line summary by name, in alphabetical order."""
    return _REGISTRY.summaries()
