"""The registry of policy searches.

Other packages add theirs by an entry point of group ``npdr_ppl.policy_searches``: its name selects
the search, its value is a subclass of :class:`~npdr_ppl.policies.policy_search.PolicySearch`.
"""

from typing import Any

from npdr_ppl.errors import ModelError
from npdr_ppl.policies.policy_search import PolicySearch
from npdr_ppl.registry import Registry

__all__ = ["policy_search", "policy_search_class", "policy_searches"]

GROUP = "npdr_ppl.policy_searches"

BUILT_IN = {
    "cma-es": "npdr_ppl.policies.cma_es:CMAES",
    "power": "npdr_ppl.policies.power:PoWER",
    "random": "npdr_ppl.policies.random_search:RandomSearch",
}
"""Searches of this package by name; each is imported on first use."""


_REGISTRY = Registry("policy search", PolicySearch, ModelError, GROUP, BUILT_IN)


def policy_search_class(name: str) -> type[PolicySearch[Any]]:
    """Returns the class of a policy search.

    Args:
        name: Word that selects it, e.g. ``"power"``.

    Raises:
        ModelError: There is no such search, or it cannot be loaded.
    """
    return _REGISTRY.find(name)


def policy_search(name: str, **options: Any) -> PolicySearch[Any]:
    """Makes a policy search.

    Args:
        name: Word that selects it.
        options: Arguments of its constructor.

    Raises:
        ModelError: There is no such search, or it has no such option.
    """
    return _REGISTRY.make(name, options)


def policy_searches() -> dict[str, str]:
    """Returns every search's one-line summary by name, in alphabetical order."""
    return _REGISTRY.summaries()
