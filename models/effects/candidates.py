"""All effects at all ports of a simulator to which they can attach."""

from collections.abc import Iterator

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Port
from npdr_ppl.language.effect_context import SensorSpan
from npdr_ppl.language.effects import ActionEffect, Effect, SensorEffect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.effects.registry import effects

__all__ = ["attached", "candidate_effects", "sensor_groups"]

# Lengths, masses and inertias do not change during a rollout.
_LASTING_UNITS = ("m", "kg", "kg m²")


def candidate_effects(simulator: Simulator) -> tuple[Effect, ...]:
    """Returns each effect of the registry at each port to which it can attach.

    A sensor effect attaches to the channels that one device may affect; see
    :class:`~npdr_ppl.language.effects.SensorEffect`. A delay and a lag of commands also attach to
    all commands of a kind together. Drift applies to parameters that can change
    during a rollout and are not nominally zero. Effects that the simulator already has, or that
    its engine cannot apply, are left out.

    Args:
        simulator: The simulator, whose ports declare their quantities.

    Example:
        >>> from npdr_ppl.models.pendulum import Pendulum
        >>> [effect.name for effect in candidate_effects(Pendulum())][:2]
        ['hinge.viscous_friction', 'hinge.coulomb_friction']
    """
    return tuple(found for effect in effects().values() for found in attached(simulator, effect))


def attached(simulator: Simulator, effect: type[Effect]) -> Iterator[Effect]:
    """Returns one effect at each port to which it can attach; see :func:`candidate_effects`."""
    present = {effect.name for effect in simulator.effects}
    for port in _ports(simulator, effect):
        found = effect(port)
        members = (simulator.port(name) for name in simulator.port(port).channels)
        if (
            found.name not in present
            and all(map(found.suits, members))
            and _is_accepted(simulator, found)
        ):
            yield found


def sensor_groups(simulator: Simulator, span: SensorSpan) -> tuple[tuple[str, ...], ...]:
    """Returns the sensor channels that one device may measure, by name.

    Args:
        simulator: The simulator.
        span: The channels that a device measures.
    """
    ports = {port.name for port in simulator.ports if port.kind == "sensor"}
    channels = [channel for channel in simulator.sensors if channel.name in ports]
    rates = tuple(channel.name for channel in channels if channel.rate_of is not None)
    positions = tuple(channel.name for channel in channels if channel.rate_of is None)
    if span in ("position", "rate"):
        return tuple((name,) for name in (positions if span == "position" else rates))
    if span == "joint":
        rate_of = {channel.rate_of: channel.name for channel in channels if channel.rate_of}
        joints = [(name, rate_of[name]) if name in rate_of else (name,) for name in positions]
        alone = [(rate,) for position, rate in rate_of.items() if position not in positions]
        return (*joints, *alone)
    group = {"positions": positions, "rates": rates}.get(span, (*positions, *rates))
    return (group,) if group else ()


def _ports(simulator: Simulator, effect: type[Effect]) -> Iterator[str]:
    """Returns the names of ports and groups of ports that an effect may attach to."""
    kinds = set(effect.port_kinds)
    if issubclass(effect, SensorEffect) and "sensor" in kinds:
        kinds.remove("sensor")
        groups = [g for span in effect.spans for g in sensor_groups(simulator, span)]
        if any("{port}" in parameter.unit for parameter in effect.parameters):
            groups = [part for group in groups for part in _by_unit(simulator, group)]
        yield from dict.fromkeys(",".join(group) for group in groups)
    if issubclass(effect, ActionEffect) and effect.may_be_shared:
        for kind in effect.port_kinds:
            group = [port.name for port in simulator.all_ports if port.kind == kind]
            if len(group) > 1:
                yield ",".join(group)
    lasting = {p.name for p in simulator.parameters if not _may_drift(p.unit, p.nominal)}
    for port in simulator.all_ports:
        if port.kind in kinds and not (port.kind == "parameter" and port.name in lasting):
            yield port.name


def _is_accepted(simulator: Simulator, effect: Effect) -> bool:
    """Returns whether a simulator accepts an effect; some engines cannot apply some effects."""
    try:
        simulator.with_effects(effect)
    except ModelError:
        return False
    return True


def _by_unit(simulator: Simulator, group: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Returns a group divided into groups of one unit each."""
    ports: list[Port] = [simulator.port(name) for name in group]
    units = dict.fromkeys(port.unit for port in ports)
    return [tuple(port.name for port in ports if port.unit == unit) for unit in units]


def _may_drift(unit: str, nominal: float) -> bool:
    return nominal != 0.0 and unit not in _LASTING_UNITS
