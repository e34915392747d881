"""Environment ports of a MuJoCo model: gravity, payloads and contact."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.mujoco.added_mass import with_point_mass
from npdr_ppl.engines.mujoco.batches import can_move_centre
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.language.channels import Port
from npdr_ppl.language.effects import Effect, EnvironmentEffect, LoadEffect

__all__ = ["EnvironmentPort", "environment_ports", "with_environment"]

# Contact coefficients: the arrays and columns that contain each, and the power of the coefficient
# to which a number is proportional. A contact's stiffness is proportional to the inverse square of
# its time constant. MuJoCo has no number for restitution.
_CONTACT = {
    "friction": (("geom_friction", 0, 1.0), ("pair_friction", 0, 1.0), ("pair_friction", 1, 1.0)),
    "rolling": (("geom_friction", 2, 1.0), ("pair_friction", 3, 1.0), ("pair_friction", 4, 1.0)),
    "compliance": (("geom_solref", 0, 0.5), ("pair_solref", 0, 0.5)),
}


_FREE = 6
"""Degrees of freedom of a body that floats."""


class EnvironmentPort(NamedTuple):
    """An environment port, with the body that carries the payload if it is a payload port.

    Attributes:
        port: The port.
        body: Number of the body; ``None`` for gravity and contact.
    """

    port: Port
    body: int | None = None


def environment_ports(
    model: Any, driven: NDArray[np.bool_], taken: Sequence[str]
) -> tuple[EnvironmentPort, ...]:
    """Returns gravity, a payload on every last link and floating base, and contact.

    A port exists only if the file has such a quantity. A payload's place is the centre of mass of
    its body. Its port is called ``payload``, or ``<body>.payload`` if there are several. It is
    rated by the mass of all moving bodies from the base to it, and by their length if the centre
    of mass can be moved.

    Args:
        model: A ``mujoco.MjModel``.
        driven: Which degrees of freedom actuators move.
        taken: Names of channels, joints and parameters.
    """
    ports = []
    gravity = float(np.linalg.norm(model.opt.gravity))
    if gravity > 0.0:
        ports.append(EnvironmentPort(Port("gravity", "environment", "m/s²", gravity)))
    bodies, names = _loaded_bodies(model, driven), element_names(model, "body")
    for body in bodies:
        is_alone = len(bodies) == 1 and "payload" not in taken
        name = "payload" if is_alone else f"{names[body]}.payload"
        mass, length = _chain(model, body)
        port = Port(name, "environment", "kg", mass)
        if can_move_centre(model, body):
            port = replace(port, rated_position=length, coordinate="m")
        ports.append(EnvironmentPort(port, body))
    if _has_contacts(model):
        ports.append(EnvironmentPort(Port("contact", "environment", "1")))
    return tuple(ports)


def with_environment(
    model: Any,
    ports: Sequence[EnvironmentPort],
    effects: Sequence[Effect],
    parameters: Sequence[Mapping[str, Tensor]],
    assignments: Assignments,
) -> Assignments:
    """Returns the values to write into the model after environment effects have changed them.

    Args:
        model: A ``mujoco.MjModel``.
        ports: Its environment ports.
        effects: All effects of a simulator.
        parameters: Parameters of each by short name, in float64.
        assignments: Values to write without these effects.
    """
    by_name = {port.port.name: port for port in ports}
    result = dict(assignments)

    for effect, values in zip(effects, parameters, strict=True):
        if not isinstance(effect, EnvironmentEffect) or effect.port not in by_name:
            continue
        port = by_name[effect.port]
        if port.body is not None:
            mass = present(model, "body_mass", port.body, result)
            total = effect.environment(mass, values)
            if isinstance(effect, LoadEffect):
                result = with_point_mass(model, port.body, total, effect.place(values), result)
            else:
                result["body_mass", port.body] = total
        elif port.port.name == "gravity":
            gravity = tuple(present(model, "opt.gravity", i, result) for i in range(3))
            changed = effect.environment(gravity, values)
            result |= {("opt.gravity", i): g for i, g in enumerate(changed)}
        else:
            one = torch.ones((), dtype=torch.float64)
            factors = effect.environment({name: one for name in _CONTACT}, values)
            for name, targets in _CONTACT.items():
                for array, column, power in targets:
                    table = np.asarray(getattr(model, array))
                    for row in range(len(table)):
                        place = row * table.shape[1] + column
                        number = float(table[row, column])
                        # Negative values of solref are a stiffness, the inverse of compliance.
                        exponent = -1.0 if number < 0.0 and "solref" in array else power
                        value = present(model, array, place, result)
                        result[array, place] = value * factors[name] ** exponent
    return result


def _loaded_bodies(model: Any, driven: NDArray[np.bool_]) -> list[int]:
    """Returns the bodies that move and carry no other moving body, and all floating bases."""
    welded = np.asarray(model.body_weldid)
    moving = [b for b in range(model.nbody) if welded[b] == b and b != 0]
    carriers = {int(welded[model.body_parentid[body]]) for body in moving}
    floating = {
        body
        for body in moving
        if welded[model.body_parentid[body]] == 0
        and not driven[np.asarray(model.dof_bodyid) == body].any()
    }
    return [body for body in moving if body not in carriers or body in floating]


def _chain(model: Any, last: int) -> tuple[float, float]:
    """Returns the mass in kg of the moving bodies from the base to the last one, and their length.

    The base of what floats counts as the last body of its own. The length in m leads from joint to
    joint and to the last body's centre of mass, and is at least the size of this body.
    """
    body, bodies = last, list[int]()
    while body and model.body_weldid[body]:
        is_floating = model.body_dofnum[body] == _FREE
        if is_floating and bodies:
            break
        bodies.append(body)
        body = int(model.body_parentid[body])
    mass = sum(float(model.body_mass[b]) for b in bodies) or float(model.body_subtreemass[last])
    # How far the first body is from the world's origin does not matter.
    offsets = [np.linalg.norm(model.body_pos[b]) for b in bodies[:-1]]
    length = float(sum(offsets) + np.linalg.norm(model.body_ipos[last]))
    # A rod of length l has the inertia m l²/12.
    own = float(model.body_mass[last])
    size = float(np.sqrt(12.0 * model.body_inertia[last].max() / own)) if own else 0.0
    return mass or 1.0, max(length, size) or float(model.stat.extent)


def _has_contacts(model: Any) -> bool:
    """Returns whether two geoms may collide, at least one of which moves."""
    if model.npair:
        return True
    mujoco: Any = importlib.import_module("mujoco")
    off = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    if int(model.opt.disableflags) & off:
        return False
    kind, affinity = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
    body = np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)]
    may = (kind[:, None] & affinity) | (affinity[:, None] & kind)
    return bool(np.any((may != 0) & (body[:, None] != body)))
