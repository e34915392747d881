"""One joint of an SO-101 arm behind its position servo."""

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from npdr_ppl import Channel, Inputs, ODESimulator, Parameter, Port, simulate
from npdr_ppl.language.effect_context import Servo


class Joint(ODESimulator):
    """J q̈ = K (u − q) − d q̇ + W cos q: a servo with goal u holds a weight of moment W."""

    states = sensors = (Channel("angle", "rad"), Channel("velocity", "rad/s", rate_of="angle"))
    actions = (Channel("goal", "rad"),)
    parameters = (
        Parameter("inertia", "kg m²", 0.03, "of rotor and links"),
        Parameter("stiffness", "N m/rad", 10.0, "gain of the servo"),
        Parameter("damping", "N m s/rad", 1.0, "of servo and gear"),
        Parameter("weight", "N m", 0.0, "moment of the weight at an angle of 0"),
    )
    joints = ("joint",)
    ports = (
        Port("goal", "servo", "rad", joint="joint"),
        Port("joint", "force", "N m", rated_speed=0.5),
        Port("angle", "sensor", "rad"),
        Port("velocity", "sensor", "rad/s", rated=0.5),
    )
    time_step = 0.02

    def environment(self, parameters: dict) -> dict:
        """Lets effects change the servo."""
        return {"goal": Servo(parameters["stiffness"])}

    def accelerations(self, positions: tuple, velocities: tuple, *others: tuple) -> tuple:
        """Returns q̈ under actions and the forces of effects, for the constants of the model."""
        (angle,), (velocity,), ((goal,), (force,), constants) = positions, velocities, others
        servo = constants["goal"]
        torque = (servo.gain * (goal - angle)).clamp(-servo.limit, servo.limit) + force
        weight, friction = constants["weight"] * torch.cos(angle), constants["damping"] * velocity
        return ((torque + weight - friction) / constants["inertia"],)


def wrist_pitch(inputs: Inputs) -> Tensor:
    """The known weight of the hand tells the gain of the servo and the inertia."""
    return joint(inputs, weight=0.117)


def pan(inputs: Inputs) -> Tensor:
    """The base lifts nothing; the known inertia tells the gain of the servo."""
    return joint(inputs, inertia=0.093)


def joint(inputs: Inputs, **known: float | Tensor) -> Tensor:
    """A servo with viscous friction and nothing else."""
    known["stiffness"] = pyro.sample("stiffness", dist.LogNormal(2.3, 1.0))  # N m/rad
    if "inertia" not in known:
        known["inertia"] = pyro.sample("inertia", dist.LogNormal(-3.5, 0.7))  # kg m²
    known["damping"] = pyro.sample("damping", dist.LogNormal(0.0, 1.0))  # N m s/rad
    return simulate("trajectory", Joint(), known, inputs)
