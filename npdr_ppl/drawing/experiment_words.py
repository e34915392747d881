"""What would tell alternatives apart, in words for a terminal and a report."""

from collections.abc import Mapping
from typing import Any

from npdr_ppl.drawing.numbers import number

__all__ = ["ranges_of_commands", "values_that_differ"]


def values_that_differ(experiment: Mapping[str, Any]) -> str:
    """Returns the parameters on which alternatives disagree, with the value of each; or nothing.

    Args:
        experiment: The next experiment of a ``discovery.json``.
    """
    differing = experiment.get("differing") or {}
    return " or ".join(
        f"{name} ({', '.join(f'{number(value)} with {cause}' for cause, value in values.items())})"
        for name, values in differing.items()
    )


def ranges_of_commands(experiment: Mapping[str, Any]) -> str:
    """Returns the greatest command of each action, and the least one if it has the same sign.

    Args:
        experiment: The next experiment of a ``discovery.json``.
    """
    least = experiment.get("least") or {}
    return ", ".join(
        f"{name} from {least[name]:.3g} to {value:.3g}"
        if least.get(name, -value) != -value
        else f"{name} up to {value:.3g}"
        for name, value in experiment["amplitude"].items()
    )
