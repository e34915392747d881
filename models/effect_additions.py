"""Adds effects of a user's Python file to the registry, after checks, and removes them."""

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.added_files import added_files, added_folder, declared_ids
from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ComplianceEffect, Effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models import zoo
from npdr_ppl.models.effects import effects
from npdr_ppl.models.effects.added import added_effects
from npdr_ppl.models.effects.candidates import attached
from npdr_ppl.models.effects.effect_files import effects_of
from npdr_ppl.python_files import check_exists, load_python_file
from npdr_ppl.registry import hint

__all__ = ["Addition", "add_file", "check_effect", "remove_file"]

_ROUNDING = 1e-9
"""Trajectories that differ by less, in a sensor's unit, are taken as equal where an effect adds a
joint."""

SIMULATORS = ("pendulum", "furuta", "cart_pole", "emps", "two_link_arm")
"""Models of the zoo on which an effect is checked: the first that has a port for it."""

SERVO = """<mujoco><option timestep="0.01"/><worldbody>
<body><joint name="joint" axis="0 1 0" damping="0.1"/><geom size="0.05" pos="0.2 0 0"/></body>
</worldbody><actuator><position name="goal" joint="joint" kp="4"/></actuator></mujoco>"""
"""A link with a servo, for effects at servos, which no model of the zoo has."""

NUM_STEPS = 50
"""Time steps of the check, 1 s of the pendulum: long enough for memories and delays to act."""


@dataclass(frozen=True)
class Addition:
    """What was added or removed.

    Attributes:
        file: The file in the folder of added effects.
        ids: Its effects.
        unchecked: Those that no model of the zoo could check.
    """

    file: Path
    ids: tuple[str, ...]
    unchecked: tuple[str, ...] = ()


def add_file(path: Path) -> Addition:
    """Copies a file to the folder of added effects; its effects are then in the registry.

    Args:
        path: The Python file.

    Raises:
        ModelError: The file cannot be loaded or has no effect; an effect's id is taken; its
            priors are not those of its parameters; or it changes a trajectory although its
            parameters are nominal.
    """
    check_exists(path, "*.py")
    found = tuple(effects_of(load_python_file(path), path).values())
    ids = tuple(effect.id for effect in found)
    for effect in found:
        _check_free(effect.id, path)
        if ids.count(effect.id) > 1:
            raise ModelError(f"{path} has two effects of the id {effect.id!r}; change one.")
    unchecked = tuple(effect.id for effect in found if not check_effect(effect, path))
    folder = added_folder()
    folder.mkdir(parents=True, exist_ok=True)
    # The first id is the name, because two files may both be called learned_effect.py.
    copy = folder / f"{ids[0]}.py"
    if copy.exists():
        raise ModelError(
            f"{copy} exists already; remove it first with `npdr effects --remove {copy.name}`."
        )
    with replacing(copy) as temporary:
        temporary.write_bytes(path.read_bytes())
    try:
        effects_of(load_python_file(copy), copy)
    except ModelError as error:
        copy.unlink()
        raise ModelError(
            f"{path} works only in its own folder, because it needs files there; an added file "
            f"has to stand alone. ({error})"
        ) from error
    return Addition(copy, ids, unchecked)


def remove_file(word: str) -> Addition:
    """Deletes the file of an added effect, and with it all effects of this file.

    Args:
        word: Id of the effect, or the name of its file, which may be broken.

    Raises:
        ModelError: The user has added no such effect.
    """
    own = {name: added.file for name, added in added_effects().items()}
    ids = {file: declared_ids(file) for file in added_files()}
    for file, names in ids.items():
        names += [name for name, home in own.items() if home == file and name not in names]
        if word in (*names, file.name):
            file.unlink()
            return Addition(file, tuple(names))
    if word in effects():
        raise ModelError(f"{word!r} is not an effect that you added; only those can be removed.")
    known = [name for names in ids.values() for name in names]
    raise ModelError(f"You have added no effect {word!r}; {hint(word, known)}")


def check_effect(effect: type[Effect], path: Path) -> bool:
    """Checks an effect on a model of the zoo.

    Args:
        effect: The effect.
        path: Its file, for messages.

    Returns:
        Whether a model has a port for it. If not, nothing was checked.

    Raises:
        ModelError: The effect has priors other than those of its parameters, its code raises an
            error, or it changes a trajectory although its parameters are nominal.
    """
    label = f"{effect.__name__} in {path}"
    try:
        for simulator in _simulators():
            found = tuple(attached(simulator, effect))
            for one in found:
                _check_priors(one, simulator, label)
                _check_nominal(one, simulator, label)
            if found:
                return True
    except ModelError:
        raise
    except Exception as error:
        raise ModelError(f"{label} fails: {type(error).__name__}: {error}.") from error
    return False


def _check_free(name: str, path: Path) -> None:
    """Raises a ModelError if there is an effect of the same id."""
    added = {key: own.file for key, own in added_effects().items()}
    if name in added:
        raise ModelError(
            f"You have added an effect {name!r} already, {added[name]}; remove it with "
            f"`npdr effects --remove {name}`, or change the id in {path}."
        )
    if name in effects():
        raise ModelError(
            f"`npdr effects` has an effect {name!r} already; change the id in {path}."
        )


def _check_priors(effect: Effect, simulator: Simulator, label: str) -> None:
    priors: Mapping[str, Distribution] = effect.default_priors(simulator.port(effect.channels[0]))
    names = [parameter.name for parameter in effect.parameters]
    missing = [name for name in names if not isinstance(priors.get(name), Distribution)]
    if missing:
        raise ModelError(f"{label} has no prior of {', '.join(missing)}; default_priors gives it.")
    other = [name for name in priors if name not in names]
    if other:
        raise ModelError(f"{label} has a prior of {', '.join(other)}, which is no parameter.")


def _check_nominal(effect: Effect, simulator: Simulator, label: str) -> None:
    inputs = _driven(simulator)
    rig = simulator.with_effects(effect)
    port = simulator.port(effect.port)
    effect.units(port)
    typical = effect.probe(port)
    given = {f"{effect.name}.{name}": _number(value) for name, value in typical.items()}
    rig.simulate(given, inputs)  # which may raise an error
    nominal = {
        site: _number(parameter.nominal)
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
    }
    found, plain = rig.simulate(nominal, inputs), simulator.simulate({}, inputs)
    # Effects that add a joint change the order of sums.
    room = _ROUNDING if isinstance(effect, ComplianceEffect) else 0.0
    if not torch.allclose(found, plain, rtol=0.0, atol=room):
        values = ", ".join(f"{p.name} = {p.nominal:g}" for p in effect.parameters)
        raise ModelError(
            f"{label} changes the trajectory of {simulator.name} although its parameters are "
            f"nominal ({values}); the nominal values have to mean zero strength, bit for bit."
        )


def _number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def _simulators() -> Iterator[Simulator]:
    entries = zoo()
    for name in SIMULATORS:
        yield entries[name].simulator()
    from npdr_ppl.engines.mujoco import MujocoSimulator

    mujoco: Any = importlib.import_module("mujoco")
    yield MujocoSimulator(mujoco.MjModel.from_xml_string(SERVO))


def _driven(simulator: Simulator) -> Inputs:
    """Returns a segment in which random commands move a simulator from a random state."""
    generator = torch.Generator().manual_seed(0)
    rated = {port.name: port.rated for port in simulator.ports}
    # Of commands the rated values, and of states values that no joint is limited to.
    scales = [rated.get(action.name, 1.0) for action in simulator.actions]
    actions = torch.randn(NUM_STEPS, len(scales), generator=generator, dtype=torch.float64)
    state = torch.randn(len(simulator.states), generator=generator, dtype=torch.float64)
    return Inputs.single(
        actions * torch.tensor(scales, dtype=torch.float64),
        0.1 * state,
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(channel.name for channel in simulator.states),
        time_step=simulator.time_step,
    )
