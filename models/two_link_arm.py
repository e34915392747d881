"""A robot arm of two links in a vertical plane, simulated by MuJoCo."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pyro
import pyro.distributions as dist
from torch import Tensor

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import simulate

__all__ = ["LOWER_LENGTH", "UPPER_LENGTH", "TwoLinkArm", "two_link_arm"]

UPPER_LENGTH = 0.4
"""Distance from shoulder to elbow, in m, as in the file."""

LOWER_LENGTH = 0.35
"""Length of the lower link, in m, as in the file."""

_XML = Path(__file__).with_name("two_link_arm.xml")


class TwoLinkArm(MujocoSimulator):
    """Two uniform thin rods, each driven by a motor at its joint; both angles are 0 when hanging.

    The elbow's angle is relative to the upper link. A payload is at the lower link's centre, the
    place of MuJoCo's port.

    Args:
        substeps: Number of engine steps per step.
        num_threads: Number of threads; ``None`` for as many as torch uses.
    """

    def __init__(self, *, substeps: int = 1, num_threads: int | None = None) -> None:
        super().__init__(
            _XML,
            {
                "upper_mass": "body upper mass",
                "lower_mass": "body lower mass",
                "shoulder_damping": "joint shoulder damping",
                "elbow_damping": "joint elbow damping",
            },
            derived={
                "body upper inertia x": _rod("upper_mass", UPPER_LENGTH),
                "body upper inertia y": _rod("upper_mass", UPPER_LENGTH),
                "body lower inertia x": _rod("lower_mass", LOWER_LENGTH),
                "body lower inertia y": _rod("lower_mass", LOWER_LENGTH),
            },
            # The plain names are those of the joints, where forces act.
            states={
                "shoulder_angle": "shoulder",
                "elbow_angle": "elbow",
                "shoulder_velocity": "shoulder_velocity",
                "elbow_velocity": "elbow_velocity",
            },
            time_step=0.005,
            substeps=substeps,
            num_threads=num_threads,
        )


def two_link_arm(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The arm with unknown masses and dampings.

    Args:
        inputs: Segments with :class:`TwoLinkArm`'s channels.
        noise: Measurement noise.
    """
    parameters = {
        "upper_mass": pyro.sample("upper_mass", dist.Uniform(0.6, 1.8)),  # kg
        "lower_mass": pyro.sample("lower_mass", dist.Uniform(0.4, 1.2)),  # kg
        "shoulder_damping": pyro.sample("shoulder_damping", dist.Uniform(0.0, 0.4)),  # N m s/rad
        "elbow_damping": pyro.sample("elbow_damping", dist.Uniform(0.0, 0.15)),  # N m s/rad
    }
    return simulate("trajectory", TwoLinkArm(), parameters, inputs, noise=noise)


def _rod(mass: str, length: float) -> Callable[[Mapping[str, Tensor]], Tensor]:
    """Returns the inertia of a thin rod across its length, about its centre, in kg m²."""
    return lambda parameters: parameters[mass] * (length * length / 12.0)
