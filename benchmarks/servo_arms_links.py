"""Two arms behind position servos, as MJCF text made from public inertial values.

Six joints like an UR5e's, seven like a Kinova Gen3's; values are rounded, and those of the drives
are typical ones. No body has a geom, so nothing touches.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["ARMS", "GRAVITY", "TIME_STEP", "Arm", "Array", "Link", "Values", "mjcf"]

Array = NDArray[np.float64]

GRAVITY = 9.81
"""m/s²."""

TIME_STEP = 2e-3
"""Seconds of a sample, and of a step of the file."""


@dataclass(frozen=True)
class Link:
    """A link with its joint and the servo that turns it.

    Attributes:
        joint: Name of the joint.
        place: Its place in the frame of the link before, m.
        turn: Turn of its frame about the x axis of the frame before, rad.
        axis: Its axis.
        mass: Mass, kg.
        centre: Centre of mass, m.
        inertia: Principal moments of inertia about it, kg m².
        armature: Moment of inertia of the drive, kg m².
        damping: Viscous friction of the joint, N m s/rad.
        gains: Torque per position error, N m/rad, and per speed, N m s/rad.
        limit: Greatest torque, N m.
        home: Middle of the commands, rad.
        amplitude: Greatest distance of a command from it, rad.
        is_loaded: Whether gravity loads the joint.
    """

    joint: str
    place: tuple[float, float, float]
    turn: float
    axis: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]
    armature: float
    damping: float
    gains: tuple[float, float]
    limit: float
    home: float
    amplitude: float
    is_loaded: bool

    @property
    def servo(self) -> str:
        """Name of the servo."""
        return f"{self.joint}_servo"

    @property
    def force_port(self) -> str:
        """Name of the port of the joint's torque; the joint's name is the position's."""
        return f"{self.joint}_torque"


@dataclass(frozen=True)
class Values:
    """The values of an arm that vary, each ``(n,)``.

    Attributes:
        masses: Masses of the links, kg; the moments of inertia grow with them.
        armatures: Moments of inertia of the drives, kg m².
        dampings: Viscous friction of the joints, N m s/rad.
    """

    masses: Array
    armatures: Array
    dampings: Array


@dataclass(frozen=True)
class Arm:
    """An arm.

    Attributes:
        name: Its name.
        links: Its links, from the base on.
        flange: Place of the flange in the last link's frame, m.
    """

    name: str
    links: tuple[Link, ...]
    flange: tuple[float, float, float]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(link.joint for link in self.links)

    @property
    def tip(self) -> Array:
        """Place of a tool's mass in the last link's frame, m: 8 cm beyond the flange, 5 aside."""
        ahead = np.array(self.flange)
        return ahead + 0.08 * ahead / np.linalg.norm(ahead) + np.array([0.05, 0.0, 0.0])

    @cached_property
    def public(self) -> Values:
        """The public values."""
        return Values(
            np.array([link.mass for link in self.links]),
            np.array([link.armature for link in self.links]),
            np.array([link.damping for link in self.links]),
        )


_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_UR_LARGE: dict[str, Any] = {"armature": 0.1, "gains": (2000.0, 200.0), "limit": 150.0}
_UR_SMALL: dict[str, Any] = {"armature": 0.05, "gains": (500.0, 50.0), "limit": 28.0}
_WRIST = (0.0026, 0.0026, 0.0022)

_SIX = Arm(
    "six",
    (
        Link(
            "shoulder_pan",
            (0.0, 0.0, 0.1625),
            0.0,
            _Z,
            3.761,
            (0.0, -0.0256, 0.0019),
            (0.0084, 0.0064, 0.0084),
            damping=2.0,
            home=0.0,
            amplitude=0.8,
            is_loaded=False,
            **_UR_LARGE,
        ),
        Link(
            "shoulder_lift",
            (0.0, 0.138, 0.0),
            0.0,
            _Y,
            8.058,
            (0.0, -0.024, 0.2125),
            (0.1339, 0.1339, 0.0151),
            damping=2.0,
            home=-1.2,
            amplitude=0.4,
            is_loaded=True,
            **_UR_LARGE,
        ),
        Link(
            "elbow",
            (0.0, -0.131, 0.425),
            0.0,
            _Y,
            2.846,
            (0.0, 0.0265, 0.15),
            (0.0312, 0.0312, 0.0041),
            damping=1.0,
            home=1.6,
            amplitude=0.5,
            is_loaded=True,
            **_UR_LARGE,
        ),
        Link(
            "wrist_1",
            (0.0, 0.0, 0.392),
            0.0,
            _Y,
            1.37,
            (0.0, 0.111, -0.0018),
            _WRIST,
            damping=0.5,
            home=-0.4,
            amplitude=0.7,
            is_loaded=True,
            **_UR_SMALL,
        ),
        Link(
            "wrist_2",
            (0.0, 0.127, 0.0),
            0.0,
            _Z,
            1.3,
            (0.0, 0.0018, 0.0834),
            _WRIST,
            damping=0.5,
            home=0.6,
            amplitude=0.8,
            is_loaded=False,
            **_UR_SMALL,
        ),
        Link(
            "wrist_3",
            (0.0, 0.0, 0.0997),
            0.0,
            _Y,
            0.365,
            (0.0, 0.0984, 0.0),
            (0.0003, 0.0002, 0.0003),
            damping=0.5,
            home=0.0,
            amplitude=1.0,
            is_loaded=False,
            **_UR_SMALL,
        ),
    ),
    flange=(0.0, 0.0996, 0.0),
)
"""Like an UR5e, upright at zero, from public inertial values; its drives are typical ones."""

_HALF_TURN, _QUARTER = math.pi, 0.5 * math.pi
_GEN3_LARGE: dict[str, Any] = {"armature": 0.1, "damping": 1.0, "gains": (1000.0, 100.0)}
_GEN3_LARGE |= {"limit": 39.0}
_GEN3_SMALL: dict[str, Any] = {"armature": 0.03, "damping": 0.4, "gains": (400.0, 30.0)}
_GEN3_SMALL |= {"limit": 9.0}

_SEVEN = Arm(
    "seven",
    (
        Link(
            "joint_1",
            (0.0, 0.0, 0.1564),
            _HALF_TURN,
            _Z,
            1.377,
            (0.0, -0.0104, -0.0734),
            (0.0048, 0.0046, 0.0014),
            home=0.0,
            amplitude=0.8,
            is_loaded=False,
            **_GEN3_LARGE,
        ),
        Link(
            "joint_2",
            (0.0, 0.0054, -0.1284),
            _QUARTER,
            _Z,
            1.164,
            (0.0, -0.0996, -0.0133),
            (0.0111, 0.0011, 0.0112),
            home=0.3,
            amplitude=0.5,
            is_loaded=True,
            **_GEN3_LARGE,
        ),
        Link(
            "joint_3",
            (0.0, -0.2104, -0.0064),
            -_QUARTER,
            _Z,
            1.164,
            (0.0, -0.0066, -0.1179),
            (0.0109, 0.0111, 0.0010),
            home=3.1,
            amplitude=0.6,
            is_loaded=False,
            **_GEN3_LARGE,
        ),
        Link(
            "joint_4",
            (0.0, 0.0064, -0.2104),
            _QUARTER,
            _Z,
            0.930,
            (0.0, -0.0755, -0.0150),
            (0.0081, 0.0006, 0.0083),
            home=-2.0,
            amplitude=0.5,
            is_loaded=True,
            **_GEN3_LARGE,
        ),
        Link(
            "joint_5",
            (0.0, -0.2084, -0.0064),
            -_QUARTER,
            _Z,
            0.678,
            (0.0, -0.0094, -0.0639),
            (0.0016, 0.0016, 0.0004),
            home=0.0,
            amplitude=0.8,
            is_loaded=False,
            **_GEN3_SMALL,
        ),
        Link(
            "joint_6",
            (0.0, 0.0002, -0.1059),
            _QUARTER,
            _Z,
            0.678,
            (0.0, -0.0455, -0.0097),
            (0.0016, 0.0004, 0.0016),
            home=0.9,
            amplitude=0.6,
            is_loaded=True,
            **_GEN3_SMALL,
        ),
        Link(
            "joint_7",
            (0.0, -0.1059, -0.0002),
            -_QUARTER,
            _Z,
            0.501,
            (0.0, 0.0, -0.0229),
            (0.0006, 0.0006, 0.0004),
            home=1.6,
            amplitude=1.0,
            is_loaded=False,
            **_GEN3_SMALL,
        ),
    ),
    flange=(0.0, 0.0, -0.0615),
)
"""Like a Kinova Gen3, upright at zero, from public inertial values; its drives are typical ones.
Its flange is 4 cm beyond the last link's centre of mass; of the six-joint arm it is 1 mm."""

ARMS = {arm.name: arm for arm in (_SIX, _SEVEN)}
"""The arms by name."""


def mjcf(
    arm: Arm,
    values: Values,
    *,
    time_step: float = TIME_STEP,
    integrator: str = "implicitfast",
    payload: float = 0.0,
    tool: float = 0.0,
    gravity: Sequence[float] = (0.0, 0.0, -GRAVITY),
    gains: Array | None = None,
) -> str:
    """Returns an arm as an MJCF file.

    Args:
        arm: The arm.
        values: Its values.
        time_step: Seconds.
        integrator: MuJoCo's name of the integrator.
        payload: Mass at the flange, kg.
        tool: Mass at the tip of a tool, kg.
        gravity: Gravity in the base's frame, m/s².
        gains: Torque per position error of each servo, N m/rad; the arm's own if not given.
    """
    stiffness = np.array([link.gains[0] for link in arm.links]) if gains is None else gains
    bodies = ends = ""
    for i, link in enumerate(arm.links):
        mass, usual = values.masses[i], link.mass
        bodies += (
            f'<body name="{link.joint}_link" pos="{_text(link.place)}" '
            f'euler="{link.turn!r} 0 0">\n'
            f'<joint name="{link.joint}" axis="{_text(link.axis)}" '
            f'armature="{values.armatures[i]:.17g}" damping="{values.dampings[i]:.17g}"/>\n'
            f'<inertial pos="{_text(link.centre)}" mass="{mass:.17g}" '
            f'diaginertia="{_text(moment * mass / usual for moment in link.inertia)}"/>\n'
        )
        ends += "</body>\n"
    for name, place, mass in (("load", arm.flange, payload), ("tool", arm.tip.tolist(), tool)):
        if mass:
            bodies += (
                f'<body name="{name}" pos="{_text(place)}">'
                f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="1e-9 1e-9 1e-9"/></body>\n'
            )
    servos = "".join(
        f'<position name="{link.servo}" joint="{link.joint}" kp="{own!r}" '
        f'kv="{link.gains[1]!r}" ctrlrange="-6.28 6.28" '
        f'forcerange="{-link.limit!r} {link.limit!r}"/>\n'
        for link, own in zip(arm.links, stiffness.tolist(), strict=True)
    )
    return (
        f'<mujoco model="{arm.name}">\n<compiler autolimits="true" angle="radian"/>\n'
        f'<option timestep="{time_step!r}" integrator="{integrator}" '
        f'gravity="{_text(gravity)}"/>\n<worldbody>\n{bodies}{ends}</worldbody>\n'
        f"<actuator>\n{servos}</actuator>\n</mujoco>\n"
    )


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
