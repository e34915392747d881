"""Cases of whole arms behind servos: what is hidden, how strongly, and which names are right."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from servo_arms_links import ARMS, TIME_STEP, Arm, Array, Values, mjcf
from servo_arms_rigs import FIT, HOLDOUT, Hidden, simulate
from servo_arms_separation import LATE, NOISE, Twin, alternatives, sized

import npdr_ppl as npdr
from npdr_ppl.randomness import derived_seed

__all__ = ["KINDS", "Case", "Kind", "Task", "make_case", "recorded"]

SECONDS = 10.0
"""Duration of each rollout."""

SPREAD = 0.2
"""Greatest relative difference between the rig's values and the nominal ones."""

PRIOR = 0.4
"""Greatest relative difference that the priors of the model under test allow."""

SUBSTEPS = (8, 10, 16, 20)
"""Steps of the rig per sample, 0.25 to 0.1 ms; the seed chooses."""


@dataclass(frozen=True)
class Kind:
    """A kind of hidden effect.

    Attributes:
        effect: Its id in the catalogue of effects.
        place: Where it acts.
        low: Least typical size, a share of the joint's greatest torque for torques of joints.
        high: Greatest typical size.
        is_torque: Whether the sizes are such shares.
        numbers: How many numbers it takes, each of either sign if there are several.
        is_signed: Whether its sign is drawn.
    """

    effect: str
    place: Literal["joint", "loaded joint", "servo", "sensor", "bus", "payload", "gravity"]
    low: float
    high: float
    is_torque: bool = False
    numbers: int = 1
    is_signed: bool = False


_DEGREE = math.pi / 180.0

KINDS: dict[str, Kind] = {
    "dry_friction": Kind("coulomb_friction", "joint", 0.01, 0.04, is_torque=True),
    "viscous_friction": Kind("viscous_friction", "joint", 0.01, 0.04, is_torque=True),
    "quadratic_drag": Kind("quadratic_drag", "joint", 0.01, 0.04, is_torque=True),
    "load_friction": Kind("load_dependent_friction", "loaded joint", 0.04, 0.1),
    "constant_torque": Kind("bias", "joint", 0.005, 0.02, is_torque=True, is_signed=True),
    "payload": Kind("payload", "payload", 0.3, 1.0),
    "servo_delay": Kind("input_delay", "servo", 2e-3, 8e-3),
    "bus_delay": Kind("input_delay", "bus", 2e-3, 8e-3),
    "servo_gain": Kind("servo_gain", "servo", 0.05, 0.15, is_signed=True),
    "sensor_offset": Kind("encoder_bias", "sensor", 3e-3, 0.015, is_signed=True),
    "tool": Kind("offset_payload", "payload", 0.3, 1.0),
    "tilt": Kind("tilt", "gravity", 0.5 * _DEGREE, 2.0 * _DEGREE, numbers=2, is_signed=True),
}
"""What may be hidden; sizes in N m at a speed of 1 rad/s, kg, s, rad, or relative."""


MODEL = '''"""The arm of arm.xml; damping and armature of its joints are known to {percent} %."""

from pathlib import Path

import npdr_ppl as npdr
import pyro
import pyro.distributions as dist

ADDRESSES = {addresses}

arm = npdr.MujocoSimulator(Path(__file__).with_name("arm.xml"), ADDRESSES)

NOMINAL = {{parameter.name: parameter.nominal for parameter in arm.parameters}}


def model(inputs):
    parameters = {{
        name: pyro.sample(name, dist.Uniform({low} * value, {high} * value))
        for name, value in NOMINAL.items()
    }}
    return npdr.simulate("trajectory", arm, parameters, inputs)
'''
"""The user's program."""


@dataclass(frozen=True)
class Task:
    """One case to be judged.

    Attributes:
        arm: Name of the arm.
        condition: How many effects are hidden: ``"none"``, ``"one"`` or ``"two"``.
        kinds: Their kinds, or those that the seed is to choose from if there are more.
        separation: Separation to set each size by; 0 for the typical size of an arm, or more if
            that has less than ``LEAST``.
        masses: ``"known"``: those in the file are the rig's; ``"fitted"``: the file has the public
            ones, and all masses but the last link's are parameters.
        seed: The case's seed.
    """

    arm: str
    condition: str
    kinds: tuple[str, ...]
    separation: float
    masses: str
    seed: int


@dataclass(frozen=True)
class Case:
    """A case.

    Attributes:
        arm: The arm.
        given: The values in the user's file.
        true: The rig's values.
        addresses: Parameters of the model under test, with their addresses in the file.
        hidden: What is hidden.
        separations: Each one's separation.
        truth: Names that a finder should give.
        alternatives: Sets of names that the recordings cannot tell from these.
        rollouts: The recording.
    """

    arm: Arm
    given: Values
    true: Values
    addresses: Mapping[str, str]
    hidden: tuple[Hidden, ...]
    separations: tuple[float, ...]
    truth: tuple[str, ...]
    alternatives: tuple[tuple[str, ...], ...]
    rollouts: npdr.Rollouts

    def write(self, folder: Path) -> str:
        """Writes what a user has: ``arm.xml``, ``arm_model.py`` and ``rec.npz``.

        Args:
            folder: The folder; created if it does not exist.

        Returns:
            The model's name for ``npdr``.
        """
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "arm.xml").write_text(mjcf(self.arm, self.given))
        lines = "".join(f'    "{n}": "{address}",\n' for n, address in self.addresses.items())
        source = MODEL.format(
            percent=round(100 * PRIOR),
            addresses="{\n" + lines + "}",
            low=round(1.0 - PRIOR, 9),
            high=round(1.0 + PRIOR, 9),
        )
        (folder / "arm_model.py").write_text(source)
        self.rollouts.to_npz(folder / "rec.npz")
        return f"{folder / 'arm_model.py'}:model"


def make_case(task: Task) -> Case:
    """Makes a case.

    Raises:
        ValueError: No size of the effects has the separation.
    """
    arm = ARMS[task.arm]
    rng = np.random.default_rng(derived_seed(task.seed, task.arm, task.condition))
    given, true = _values(arm, task.masses, rng)
    hidden = _drawn(arm, task, rng)
    substeps = int(rng.choice(SUBSTEPS))
    twin = Twin(arm, true, _commands(arm, task))
    # Where friction in proportion to speed is hidden, the damping there is known to the user.
    known = {effect.joint for effect in hidden if effect.kind == "viscous_friction"}
    for joint in known:
        true.dampings[joint] = given.dampings[joint]
    addresses = _addresses(arm, known, task.masses)
    separations: tuple[float, ...] = ()
    others: tuple[tuple[str, ...], ...] = ()
    truth = tuple(_name(arm, effect) for effect in hidden)
    if hidden:
        nuisance = twin.derivatives(addresses)
        hidden, separations = sized(twin, hidden, nuisance, task.separation)
        others = alternatives(twin, hidden, truth, nuisance)
    rollouts = recorded(arm, true, twin.commands, hidden, substeps, task.seed)
    return Case(arm, given, true, addresses, hidden, separations, truth, others, rollouts)


def recorded(
    arm: Arm,
    true: Values,
    commands: Sequence[Array],
    hidden: Sequence[Hidden],
    substeps: int,
    seed: int,
) -> npdr.Rollouts:
    """Returns a rig's recording of positions, with noise.

    Args:
        arm: The arm.
        true: The rig's values.
        commands: Commands of each rollout, ``(steps, n)``, in rad.
        hidden: Effects.
        substeps: Steps of the rig per sample.
        seed: Seed of the noise.
    """
    readings = []
    for number, own in enumerate(commands):
        rng = np.random.default_rng(derived_seed(seed, arm.name, "noise", number))
        clean = simulate(arm, true, own, hidden, substeps=substeps)
        readings.append(clean + NOISE * rng.standard_normal(clean.shape))
    return npdr.Rollouts.from_arrays(
        readings=readings,
        actions=list(commands),
        channel_names=list(arm.joints),
        action_names=[link.servo for link in arm.links],
        time_step=TIME_STEP,
    )


def _values(arm: Arm, masses: str, rng: np.random.Generator) -> tuple[Values, Values]:
    """Draws the rig's values: all masses differ from the public ones, or one; all drives do."""
    public, number = arm.public, len(arm.links)

    def factors() -> Array:
        return rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, number)

    changed, one = factors(), int(rng.integers(number))
    if rng.random() < 0.5:
        changed = np.where(np.arange(number) == one, changed, 1.0)
    if masses == "fitted":
        changed[-1] = 1.0  # or a payload could not be told from it
    true = Values(
        public.masses * changed, public.armatures * factors(), public.dampings * factors()
    )
    known = true.masses if masses == "known" else public.masses
    return Values(known, public.armatures, public.dampings), true


def _addresses(arm: Arm, known: set[int | None], masses: str) -> dict[str, str]:
    """Returns the parameters of the model under test."""
    free = [joint for i, joint in enumerate(arm.joints) if i not in known]
    fitted = arm.joints[:-1] if masses == "fitted" else ()
    return {
        **{f"damping_{joint}": f"joint {joint} damping" for joint in free},
        **{f"armature_{joint}": f"joint {joint} armature" for joint in arm.joints},
        **{f"mass_{joint}": f"body {joint}_link mass" for joint in fitted},
    }


def _commands(arm: Arm, task: Task) -> list[Array]:
    """Returns sums of four sines of 0.1 to 0.8 Hz for each rollout, ``(steps, n)``."""
    result, number = [], len(arm.links)
    times = TIME_STEP * np.arange(round(SECONDS / TIME_STEP))[:, None, None]
    home = np.array([link.home for link in arm.links])
    amplitude = np.array([link.amplitude for link in arm.links])
    for rollout in (*FIT, *HOLDOUT):
        seed = derived_seed(task.seed, task.arm, task.condition, "commands", rollout)
        rng = np.random.default_rng(seed)
        frequency = rng.uniform(0.1, 0.8, (4, number))
        phase = rng.uniform(0.0, 2.0 * math.pi, (4, number))
        weight = rng.dirichlet(np.ones(4), number).T
        waves = np.sin(2.0 * math.pi * frequency * times + phase)
        result.append(home + amplitude * (weight * waves).sum(1))
    return result


def _drawn(arm: Arm, task: Task, rng: np.random.Generator) -> tuple[Hidden, ...]:
    """Draws kinds, joints and typical sizes; two effects are at different joints."""
    number = {"none": 0, "one": 1, "two": 2}[task.condition]
    kinds = list(task.kinds)
    if number == 2:
        pairs = [
            pair
            for pair in itertools.combinations(kinds, 2)
            # Delays of a servo and of all are not two causes.
            if set(pair) != set(LATE)
        ]
        kinds = list(pairs[int(rng.integers(len(pairs)))])
    joints = rng.permutation(len(arm.links)).tolist()
    hidden = []
    for kind in kinds[:number]:
        about = KINDS[kind]
        joint = None
        if about.place not in ("bus", "payload", "gravity"):
            needs_load = about.place == "loaded joint"
            joint = next(j for j in joints if arm.links[j].is_loaded or not needs_load)
            joints.remove(joint)
        size = rng.uniform(about.low, about.high, about.numbers)
        sign = rng.choice([-1.0, 1.0], about.numbers)
        if about.is_signed:
            size = size * sign
        if about.is_torque and joint is not None:
            size = size * arm.links[joint].limit
        hidden.append(Hidden(kind, joint, tuple(size.tolist())))
    return tuple(hidden)


def _name(arm: Arm, effect: Hidden) -> str:
    """Returns the name that a finder should give."""
    kind = KINDS[effect.kind]
    if effect.joint is None:
        servos = ",".join(link.servo for link in arm.links)
        port = servos if kind.place == "bus" else kind.place
    else:
        link = arm.links[effect.joint]
        ports = {"servo": link.servo, "sensor": link.joint}
        port = ports.get(kind.place, link.force_port)
    return f"{port}.{kind.effect}"
