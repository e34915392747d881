"""Numbers as text."""

import math
from typing import Any

__all__ = ["number"]


def number(value: Any, format_spec: str = ".3g") -> str:
    """Returns a number as text, or a dash if it is not known."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return format(value, format_spec)
