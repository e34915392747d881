"""What one row of the blind benchmark says: found, right, confident."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

from hidden_rigs import RIGS

__all__ = [
    "Judged",
    "REMOVED",
    "SEVERAL",
    "Row",
    "effect_id",
    "estimates",
    "first_probability",
    "found_names",
    "has_all",
    "has_all_classes",
    "has_any",
    "has_too_many",
    "has_wrong",
    "is_bic_right",
    "is_class_right",
    "is_confident_and_wrong",
    "is_first_right",
    "is_sparse_effect",
    "is_sparse_right",
    "is_sparse_unknown",
    "right_sets",
    "sparse_name",
]

NAMED = 0.05
"""Probability from which an alternative counts as reported."""

CONFIDENT = 0.9
"""Probability from which a name is given without doubt."""

REMOVED = ("without", "beyond")
"""Conditions in which the true effect's entry is taken from the catalogue."""

SEVERAL = ("two", "two_at_one_place", "three")
"""Conditions in which several effects are hidden."""

Row = dict[str, Any]


def effect_id(name: str) -> str:
    """Returns the effect of ``"<port>.<effect>"``."""
    return name.rsplit(".", 1)[-1]


def found_names(row: Row) -> list[str]:
    """Returns the names of :func:`large_effects`."""
    return [f"{e['port']}.{e['effect']}" for e in large_effects(row)]


def large_effects(row: Row) -> list[Row]:
    """Returns the effects that were found, without small ones and corrections of the model."""
    return [e for e in row.get("effects", []) if not e.get("is_minor") and not e.get("corrects")]


def right_sets(row: Row) -> list[set[str]]:
    """Returns the sets of names that count as right."""
    return [set(row["truth"]), *(set(names) for names in row.get("alternatives", []))]


def is_right(row: Row, name: str | None) -> bool:
    """Returns whether a name is a true one, or stands for it."""
    return name is not None and any(name in right for right in right_sets(row))


def is_first_right(row: Row) -> bool:
    """Returns whether the first effect is the true one, or stands for it."""
    return is_right(row, next(iter(found_names(row)), None))


def first_probability(row: Row) -> float:
    """Returns the reported probability that :func:`is_first_right`.

    Of the first effect, and of those that no recording of the rig can tell from it: where one of
    them is hidden, the first effect counts as right.
    """
    first, rig = large_effects(row)[0], RIGS[row["rig"]]
    table = rig.inseparable if row["condition"] == "inseparable" else rig.same
    others = table.get((first["port"], first["effect"]), ())
    alone = {
        f"{port}.{effect}" for places in others if len(places) == 1 for port, effect in places
    }
    names = {found_names(row)[0], *alone}
    return sum(first["alternatives"].get(name, 0.0) for name in names)


def is_class_right(row: Row) -> bool:
    """Returns whether the truth is the first effect or among what could stand in its place."""
    if is_first_right(row):
        return True
    if not large_effects(row):
        return False
    first = large_effects(row)[0]
    return any(stands_for(first, name) for right in right_sets(row) for name in right)


def stands_for(finding: Row, name: str) -> bool:
    """Returns whether a finding is an effect, or reports that it could be that one."""
    return (
        f"{finding['port']}.{finding['effect']}" == name
        or finding["alternatives"].get(name, 0.0) >= NAMED
        or effect_id(name) in finding["equivalent_to"]
    )


def is_confident_and_wrong(row: Row) -> bool:
    """Returns whether a wrong name was given without doubt."""
    if row.get("verdict") != "named" or not large_effects(row):
        return False
    return large_effects(row)[0]["probability"] >= CONFIDENT and not is_first_right(row)


def has_all(row: Row) -> bool:
    """Returns whether all hidden effects were found, or what stands for all."""
    return any(right <= set(found_names(row)) for right in right_sets(row))


def has_all_classes(row: Row) -> bool:
    """Returns whether all hidden effects were found, or are among what could stand in a place.

    Each in the place of another finding, where several are hidden.
    """
    return any(
        any(
            all(stands_for(*pair) for pair in zip(chosen, right, strict=True))
            for chosen in permutations(row.get("effects", []), len(right))
        )
        for right in right_sets(row)
    )


def has_any(row: Row) -> bool:
    """Returns whether one of the hidden effects was found, or stands for one."""
    return any(is_right(row, name) for name in found_names(row))


def has_too_many(row: Row) -> bool:
    """Returns whether more effects were found than any right answer has."""
    return len(found_names(row)) > max(len(right) for right in right_sets(row))


def has_wrong(row: Row) -> bool:
    """Returns whether an effect was found that is no hidden one and is not reported with one."""
    return any(
        not any(stands_for(effect, name) for right in right_sets(row) for name in right)
        for effect in large_effects(row)
    )


def is_bic_right(row: Row) -> bool:
    """Returns whether forward selection by BIC begins with a right effect."""
    return is_right(row, row["bic"])


def is_sparse_right(row: Row) -> bool:
    """Returns whether sparse regression names a right effect first."""
    return is_right(row, sparse_name(row))


def is_sparse_unknown(row: Row) -> bool:
    """Returns whether sparse regression names a term first that is no effect's."""
    return ": " in (sparse_name(row) or "")


def is_sparse_effect(row: Row) -> bool:
    """Returns whether sparse regression names an effect first."""
    return sparse_name(row) is not None and not is_sparse_unknown(row)


def sparse_name(row: Row) -> str | None:
    """Returns what sparse regression names first."""
    return row["sparse"]["first"]


@dataclass(frozen=True)
class Judged:
    """How well a parameter of an effect that is truly there was estimated.

    Attributes:
        is_inside: Whether its 90 % interval holds the truth.
        error: Its relative error, NaN if the truth is zero.
        deviation: Its posterior standard deviation relative to the truth, NaN likewise.
    """

    is_inside: bool
    error: float
    deviation: float


def estimates(row: Row) -> Iterator[Judged]:
    """Yields each parameter of the effects that are truly there."""
    for effect in row["effects"]:
        for short, estimate in effect["parameters"].items():
            site = f"{effect['port']}.{effect['effect']}.{short}"
            true = row["true_parameters"].get(site)
            if true is None or not math.isfinite(true):
                continue
            low, high = (math.nan if end is None else end for end in estimate["hdi_94"])
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            half *= 1.645 / 1.881  # from 94 % to 90 % of a normal distribution
            mean, deviation = (
                math.nan if estimate[name] is None else estimate[name] for name in ("mean", "sd")
            )
            yield Judged(
                abs(true - middle) <= half,
                abs(mean / true - 1.0) if true else math.nan,
                abs(deviation / true) if true else math.nan,
            )
