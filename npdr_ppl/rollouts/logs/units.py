"""Converts the units that robots log to SI."""

import math
import re
from difflib import get_close_matches

__all__ = ["closest_unit", "is_known", "si_unit"]

_DEGREE = math.pi / 180

_UNITS = {
    "rad": (1.0, "rad"),
    "deg": (_DEGREE, "rad"),
    "degree": (_DEGREE, "rad"),
    "degrees": (_DEGREE, "rad"),
    "°": (_DEGREE, "rad"),
    "mrad": (1e-3, "rad"),
    "rev": (2 * math.pi, "rad"),
    "turn": (2 * math.pi, "rad"),
    "turns": (2 * math.pi, "rad"),
    "rad/s": (1.0, "rad/s"),
    "deg/s": (_DEGREE, "rad/s"),
    "degree/s": (_DEGREE, "rad/s"),
    "degrees/s": (_DEGREE, "rad/s"),
    "°/s": (_DEGREE, "rad/s"),
    "dps": (_DEGREE, "rad/s"),
    "mrad/s": (1e-3, "rad/s"),
    "rpm": (2 * math.pi / 60, "rad/s"),
    "rev/s": (2 * math.pi, "rad/s"),
    "turn/s": (2 * math.pi, "rad/s"),
    "turns/s": (2 * math.pi, "rad/s"),
    "rad/s^2": (1.0, "rad/s^2"),
    "deg/s^2": (_DEGREE, "rad/s^2"),
    "m": (1.0, "m"),
    "km": (1e3, "m"),
    "cm": (1e-2, "m"),
    "mm": (1e-3, "m"),
    "um": (1e-6, "m"),
    "m/s": (1.0, "m/s"),
    "km/h": (1 / 3.6, "m/s"),
    "cm/s": (1e-2, "m/s"),
    "mm/s": (1e-3, "m/s"),
    "m/s^2": (1.0, "m/s^2"),
    "mm/s^2": (1e-3, "m/s^2"),
    "kg": (1.0, "kg"),
    "g": (1e-3, "kg"),
    "n": (1.0, "N"),
    "mn": (1e-3, "N"),
    "kn": (1e3, "N"),
    "nm": (1.0, "N m"),
    "mnm": (1e-3, "N m"),
    "ncm": (1e-2, "N m"),
    "nmm": (1e-3, "N m"),
    "v": (1.0, "V"),
    "mv": (1e-3, "V"),
    "a": (1.0, "A"),
    "ma": (1e-3, "A"),
    "w": (1.0, "W"),
    "mw": (1e-3, "W"),
    "s": (1.0, "s"),
    "ms": (1e-3, "s"),
    "us": (1e-6, "s"),
    "ns": (1e-9, "s"),
    "hz": (1.0, "Hz"),
    "khz": (1e3, "Hz"),
    "pa": (1.0, "Pa"),
    "kpa": (1e3, "Pa"),
    "bar": (1e5, "Pa"),
    "j": (1.0, "J"),
    "k": (1.0, "K"),
    "kgm^2": (1.0, "kg m^2"),
    "n/m": (1.0, "N/m"),
    "nm/rad": (1.0, "N m/rad"),
    "%": (1e-2, "1"),
    "percent": (1e-2, "1"),
    "1": (1.0, "1"),
}
"""Factor to the SI unit, and the SI unit, by unit in lower case without spaces."""


_SPELT_OUT = {
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("radian/s", "radians/s", "radpers", "radianspers"), "rad/s"),
    **dict.fromkeys(("degpers", "degreespers", "°pers"), "deg/s"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("newtonmetre", "newtonmetres", "newtonmeter", "newtonmeters"), "N m"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("amp", "amps", "ampere", "amperes"), "A"),
    **dict.fromkeys(("second", "seconds"), "s"),
}
"""The unit that is known, by a name that is not."""


def si_unit(unit: str) -> tuple[float, str]:
    """Returns the factor that converts values to SI, and the name of the SI unit.

    Example: ``si_unit("deg")`` is ``(0.01745…, "rad")``. ``g`` is the gram. A unit that is not
    known is kept: the factor is 1 and the name stays.

    Args:
        unit: Unit as a log or a person writes it, e.g. ``"mN m"`` or ``"deg/s"``.
    """
    return _UNITS.get(_plain(unit), (1.0, unit))


def is_known(unit: str) -> bool:
    """Returns whether a unit can be converted to SI."""
    return _plain(unit) in _UNITS


def closest_unit(unit: str) -> str:
    """Returns the known unit that is spelt most alike, ``""`` if none is.

    Example: ``closest_unit("degs")`` is ``"deg"``, ``closest_unit("Newton metre")`` is ``"N m"``.
    """
    word = _plain(unit)
    close = [w for w in (word, word.removesuffix("s")) if w in _UNITS or w in _SPELT_OUT]
    close += get_close_matches(word, [*_UNITS, *_SPELT_OUT], n=1, cutoff=0.7)
    if not close:
        return ""
    if close[0] in _SPELT_OUT:
        return _SPELT_OUT[close[0]]
    factor, name = _UNITS[close[0]]
    return name if factor == 1.0 else close[0]


def _plain(unit: str) -> str:
    """Returns a unit as ``_UNITS`` spells it."""
    word = re.sub(r"[\s·]|(?<!\*)\*(?!\*)", "", unit).lower()
    word = word.replace("µ", "u").replace("μ", "u")
    word = word.replace("**", "^").replace("²", "^2")
    word = re.sub(r"secs?(?![a-z])", "s", word)
    return re.sub(r"s2$", "s^2", word)
