"""Remarks on units that are likely mistakes: a misspelt one, or none beside degrees."""

from collections.abc import Sequence

from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.signal_names import role_of
from npdr_ppl.rollouts.logs.units import closest_unit, is_known, si_unit
from npdr_ppl.rollouts.notes import Remark

__all__ = ["rates_without_unit", "unknown_units"]

Stated = Sequence[tuple[str, str, str]]
"""Of each column: its name, its signal in the log, and the unit that is stated or ``""``."""


def unknown_units(stated: Stated) -> list[Remark]:
    """Returns a sentence about each unit that is not known, once, with the closest known one."""
    names: dict[str, list[str]] = {}
    for name, _, unit in stated:
        if unit and not is_known(unit):
            names.setdefault(unit, []).append(name)
    return [
        Remark(
            f"The unit {rollout_checks.shown(unit)} of {_listed(own)} is not known, so values are "
            f"not converted{f'; did you mean {close}?' if (close := closest_unit(unit)) else '.'}"
        )
        for unit, own in names.items()
    ]


def rates_without_unit(stated: Stated) -> list[Remark]:
    """Returns a sentence about velocities without a unit beside positions in degrees or the like.

    A log that has positions in degrees usually has velocities in degrees per second.
    """
    positions = {
        unit: name
        for name, signal, unit in stated
        if role_of(signal) == "position" and unit and si_unit(unit)[0] != 1.0
    }
    rates = [name for name, signal, unit in stated if role_of(signal) == "velocity" and not unit]
    if not positions or not rates:
        return []
    unit, name = next(iter(positions.items()))
    return [
        Remark(
            f"{_listed(rates)}: no unit is stated, so SI is assumed, but {_listed([name])} is in "
            f"{unit}; state {unit}/s if that is the unit."
        )
    ]


def _listed(names: Sequence[str]) -> str:
    return rollout_checks.shown(", ".join(names), 100)
