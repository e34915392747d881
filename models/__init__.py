"""The model zoo: simulators, their Pyro models, target domains, and the catalogue of effects.

May import: engines, targets, language. Start reading at ``pendulum.py``, the smallest model.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from npdr_ppl.language.simulator import Simulator
from npdr_ppl.targets.base import TargetDomain

__all__ = ["TargetEntry", "ZooEntry", "targets", "zoo"]


@dataclass(frozen=True)
class ZooEntry:
    """A model of the zoo; its module is imported on first use.

    Attributes:
        name: Name on the command line, and of the Pyro model function in its module.
        summary: One line for tables.
        location: The simulator's ``module:class``; the module holds the model, too.
    """

    name: str
    summary: str
    location: str

    @property
    def model(self) -> Callable[..., Tensor]:
        """The Pyro model, a function of the inputs."""
        return getattr(importlib.import_module(self.location.partition(":")[0]), self.name)

    @property
    def simulator(self) -> type[Simulator]:
        """The simulator's class."""
        module, _, simulator = self.location.partition(":")
        return getattr(importlib.import_module(module), simulator)


_ENTRIES = (
    ZooEntry(
        "pendulum",
        "Pendulum with unknown mass and length, torque at the hinge",
        "npdr_ppl.models.pendulum:Pendulum",
    ),
    ZooEntry(
        "furuta",
        "Furuta pendulum (Quanser Qube), nine parameters, plausible damping priors",
        "npdr_ppl.models.furuta:Furuta",
    ),
    ZooEntry(
        "furuta_paper",
        "Furuta pendulum with the prior of the NPDR paper",
        "npdr_ppl.models.furuta:Furuta",
    ),
    ZooEntry(
        "cart_pole",
        "Pole on a cart pushed by a force, with unknown masses, length and dampings",
        "npdr_ppl.models.cart_pole:CartPole",
    ),
    ZooEntry(
        "emps",
        "Positioning drive (EMPS benchmark) with unknown mass and viscous friction",
        "npdr_ppl.models.emps:Emps",
    ),
    ZooEntry(
        "two_link_arm",
        "Planar arm of two driven links in MuJoCo, with unknown masses and dampings",
        "npdr_ppl.models.two_link_arm:TwoLinkArm",
    ),
    ZooEntry(
        "mini_golf",
        "Robot arm strikes a ball past two obstacles; ten parameters of the NPDR paper",
        "npdr_ppl.models.mini_golf:MiniGolf",
    ),
    ZooEntry(
        "mini_golf_two_restitutions",
        "The same strike, rebounds off the club apart from those off obstacles",
        "npdr_ppl.models.mini_golf:MiniGolf",
    ),
)


def zoo() -> dict[str, ZooEntry]:
    """Returns every model of the zoo by name.

    Example:
        >>> "furuta" in zoo() and "mini_golf" in zoo()
        True
    """
    return {entry.name: entry for entry in _ENTRIES}


@dataclass(frozen=True)
class TargetEntry:
    """A target domain of the zoo; its module is imported on first use.

    Attributes:
        name: Name on the command line.
        summary: One line for tables.
    """

    name: str
    summary: str

    def make(self) -> TargetDomain:
        """Returns a new target domain."""
        return importlib.import_module("npdr_ppl.models.furuta_targets").furuta_target(self.name)


_TARGETS = tuple(
    TargetEntry(name, summary)
    for name, summary in (
        ("furuta-easy", "Furuta pendulum in MuJoCo, nominal but for its sensors and damping"),
        ("furuta-medium", "Furuta pendulum in MuJoCo, up to 8 % off, with some dry friction"),
        ("furuta-hard", "Furuta pendulum in MuJoCo, 10 to 20 % off, with dry friction"),
        ("furuta-random-0", "Furuta pendulum in MuJoCo drawn at random; any number will do"),
    )
)


def targets() -> dict[str, TargetEntry]:
    """Returns the target domains of the zoo by name.

    Only one of the random pendulums is listed; ``furuta_target`` makes the others.

    Example:
        >>> sorted(targets())
        ['furuta-easy', 'furuta-hard', 'furuta-medium', 'furuta-random-0']
    """
    return {entry.name: entry for entry in _TARGETS}
