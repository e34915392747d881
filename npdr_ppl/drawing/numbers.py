"""Numbers as text, those with an uncertainty with as many digits as it leaves."""

import math
from collections.abc import Sequence
from typing import Any

__all__ = ["interval", "number", "uncertain"]

MOST_DIGITS = 8
"""Maximum number of digits, so that a column of a table holds a number."""


def number(value: Any, format_spec: str = ".3g") -> str:
    """Returns a number as text, or a dash if it is not known."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return format(value, format_spec)


def uncertain(value: Any, spread: Any, least: int = 4) -> str:
    """Returns a number as text, with two digits of its uncertainty.

    Args:
        value: The number.
        spread: Its uncertainty, e.g. a standard deviation.
        least: Minimum number of significant digits.
    """
    digits = least
    if number(value) != "–" != number(spread) and value != 0.0 and spread > 0.0:
        above = math.floor(math.log10(abs(value))) - math.floor(math.log10(spread))
        digits = min(max(least, above + 2), MOST_DIGITS)
    return number(value, f".{digits}g")


def interval(bounds: Sequence[Any], least: int = 4) -> str:
    """Returns an interval as text, with two digits of its width; a dash if it is not known.

    Args:
        bounds: Both bounds, or nothing.
        least: Minimum number of significant digits.
    """
    known = [bound for bound in bounds if number(bound) != "–"]
    width = max(known) - min(known) if known else None
    return " … ".join(uncertain(bound, width, least) for bound in bounds) or "–"
