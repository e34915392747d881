"""What would tell alternatives apart, in words for a terminal and a report."""

from collections.abc import Mapping
from typing import Any

from npdr_ppl.drawing.numbers import number

__all__ = ["values_that_differ"]


def values_that_differ(experiment: Mapping[str, Any]) -> str:
    """Returns the parameters on which alternatives disagree, with their values; or nothing.

    Args:
        experiment: The next experiment of a ``discovery.json``.
    """
    differing = experiment.get("differing") or {}
    return " or ".join(
        f"{name} ({' or '.join(number(value) for value in values)})"
        for name, values in differing.items()
    )
