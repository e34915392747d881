"""A rig of the benchmark: its physics, how it is driven and read, and what it can hide."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from hidden_rigs.excitation import Band
from hidden_rigs.measurement import Measurement
from hidden_rigs.mechanics import Mechanics, Surroundings
from hidden_rigs.plant import Layout
from npdr_ppl.language.channels import Port
from npdr_ppl.language.simulator import Simulator

__all__ = ["Centring", "Place", "Rig"]

Place = tuple[str, str]
"""A port and the id of an effect there."""


@dataclass(frozen=True)
class Centring:
    """A weak feedback that keeps the joints about their middle, taken off an action's excitation.

    Attributes:
        position_gains: Command per position of each joint.
        velocity_gains: Command per velocity of each joint.
    """

    position_gains: tuple[float, ...]
    velocity_gains: tuple[float, ...]


@dataclass(frozen=True)
class Rig:
    """One rig.

    Attributes:
        name: Name in tables.
        model: The Pyro model under test.
        simulator: Makes the simulator inside it.
        mechanics: Makes the true equations of motion.
        layout: Names of ports and channels.
        known: Domain parameters that the model does not infer, at the model's values.
        unknown: Range from which each other true parameter is drawn.
        time_step: Seconds per sample.
        substeps: Integration steps per sample.
        duration: Seconds per rollout.
        amplitudes: Greatest excitation per action.
        limits: Greatest command per action.
        band: Frequencies of the excitations.
        centring: Feedback of each action.
        start_spread: How far from zero each joint may be when it is let go.
        measurement: Noise of the readings.
        effects: Effects of the catalogue that a finder can see here.
        pairs: Pairs of them that act at one place, which is a joint or a command.
        absorbed: Effects that leave no trace: the model's own parameters take their place.
        same: Effects that no recording of the rig can tell from others, with these: alternatives,
            each one effect or several together.
        inseparable: Effects that recordings from rest cannot tell from others, with these.
        rests_anywhere: Whether every pose is an equilibrium, so that every recording begins at
            rest in one.
        outside: Effects that are in no catalogue.
        engine: What makes the truth: the equations, or MuJoCo with features of its own.
    """

    name: str
    model: Callable[..., Tensor]
    simulator: Callable[[], Simulator]
    mechanics: Callable[[Mapping[str, float], Surroundings], Mechanics]
    layout: Layout
    known: Mapping[str, float]
    unknown: Mapping[str, tuple[float, float]]
    time_step: float
    substeps: int
    duration: float
    amplitudes: tuple[float, ...]
    limits: tuple[float, ...]
    band: Band
    centring: tuple[Centring, ...]
    start_spread: tuple[float, ...]
    measurement: Measurement
    effects: tuple[Place, ...]
    pairs: tuple[tuple[Place, Place], ...] = ()
    absorbed: tuple[Place, ...] = ()
    same: Mapping[Place, tuple[tuple[Place, ...], ...]] = field(default_factory=dict)
    inseparable: Mapping[Place, tuple[tuple[Place, ...], ...]] = field(default_factory=dict)
    rests_anywhere: bool = False
    outside: tuple[Place, ...] = ()
    engine: Literal["equations", "mujoco"] = "equations"

    def port(self, name: str) -> Port:
        """Returns a port of the model under test, whose rated values scale effects."""
        return self.simulator().port(name)

    @property
    def units(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Units of sensors and actions."""
        simulator = self.simulator()
        return (
            tuple(channel.unit for channel in simulator.sensors),
            tuple(channel.unit for channel in simulator.actions),
        )
