"""Every effect at every port of a simulator where it makes sense."""

from npdr_ppl.language.channels import Port
from npdr_ppl.language.effects import Effect, SensorEffect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.effects.registry import effects

__all__ = ["candidate_effects", "candidate_ports"]


def candidate_ports(simulator: Simulator) -> tuple[Port, ...]:
    """Returns all ports, and groups of sensors that may be one device's.

    The groups are all channels that report positions, all that report rates (one driver derives
    them), and all channels together (one bus delays them).
    """
    sensors = tuple(port for port in simulator.ports if port.kind == "sensor")
    rates = {channel.name for channel in simulator.sensors if channel.rate_of is not None}
    groups = (
        tuple(port.name for port in sensors if port.name not in rates),
        tuple(port.name for port in sensors if port.name in rates),
        tuple(port.name for port in sensors),
    )
    # A group of one is that channel, and a group may be all channels.
    names = dict.fromkeys(",".join(group) for group in groups if len(group) > 1)
    return (*simulator.all_ports, *(simulator.port(name) for name in names))


def candidate_effects(simulator: Simulator) -> tuple[Effect, ...]:
    """Returns each effect of the catalogue at each port where it makes sense.

    Effects that the simulator has already are left out.

    Args:
        simulator: The simulator, whose ports say what passes through them.

    Example:
        >>> from npdr_ppl.models.pendulum import Pendulum
        >>> [effect.name for effect in candidate_effects(Pendulum())][:2]
        ['hinge.viscous_friction', 'hinge.coulomb_friction']
    """
    present = {effect.name for effect in simulator.effects}
    ports = candidate_ports(simulator)
    found = []
    for effect in effects().values():
        for port in ports:
            if port.kind not in effect.port_kinds:
                continue
            attached = effect(port.name)
            members = tuple(simulator.port(name) for name in port.channels)
            if (
                attached.name not in present
                and all(attached.suits(member) for member in members)
                and (len(members) == 1 or _is_one_device(attached, members))
            ):
                found.append(attached)
    return tuple(found)


def _is_one_device(effect: Effect, channels: tuple[Port, ...]) -> bool:
    """Returns whether one device may have the effect on all channels, in the same size."""
    has_unit = any("{port}" in parameter.unit for parameter in effect.parameters)
    has_one_unit = len({channel.unit for channel in channels}) == 1
    is_shared = isinstance(effect, SensorEffect) and effect.is_shared
    return is_shared and (has_one_unit or not has_unit)
