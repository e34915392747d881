"""Effects that describe the same cause in another way, and effects that are sums of others."""

from collections.abc import Iterable

from npdr_ppl.language.effects import Effect

__all__ = ["equivalents", "irreducible"]


def irreducible(effects: Iterable[Effect], present: tuple[str, ...] = ()) -> tuple[Effect, ...]:
    """Returns the effects that are not the sum of two others at the same port.

    Asymmetric dry friction is the sum of dry friction and a bias. Searched together with both, it
    would only take a share of their probability. Searched one by one, they show which is present.

    Args:
        effects: The candidates.
        present: Names of effects that the model has already; they are left out, but may be parts
            of a sum.
    """
    effects = tuple(effects)
    names = {effect.name for effect in effects} | set(present)
    return tuple(
        effect
        for effect in effects
        if effect.name not in present
        and not any(
            all(f"{effect.port}.{part}" in names for part in parts) for parts in _sums(effect)
        )
    )


def equivalents(effect: Effect, present: Iterable[str] = ()) -> tuple[str, ...]:
    """Returns ids of causes that the data may not distinguish from an effect.

    Args:
        effect: The effect.
        present: Names of the model's effects. A sum that contains the effect is returned only if
            the model has the other parts.
    """
    at_port = {name.rsplit(".", 1)[1] for name in present if name.startswith(f"{effect.port}.")}
    result: list[str] = []
    for group in effect.equivalence:
        result += [member for member in group.members if member != effect.id]
    return tuple(
        dict.fromkeys(
            member
            for member in result
            if " + " not in member or set(member.split(" + ")) <= at_port
        )
    )


def _sums(effect: Effect) -> list[list[str]]:
    return [
        member.split(" + ")
        for group in effect.equivalence
        if effect.id in group.members
        for member in group.members
        if " + " in member
    ]
