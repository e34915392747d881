"""Short names for the signals of a log, and what their names say about them."""

import re
from collections.abc import Sequence
from typing import Literal

__all__ = ["Role", "plain_names", "role_of"]

Role = Literal["position", "velocity", "command", "effort", "other"]
"""What a signal may be; an effort (force, torque or current) may be commanded or measured."""

_ROLES: tuple[tuple[Role, re.Pattern[str]], ...] = (
    ("other", re.compile(r"covariance|layout|offset|status|error|temperature|stamp|sequence")),
    (
        "command",
        re.compile(
            r"(^|[^a-z])(cmd|commands?|actions?|target|goal|desired|des|setpoint|ref|reference|"
            r"control|ctrl|voltage|u|effort_control|pwm|input)([^a-z]|$)|_(control|command)s?\b"
        ),
    ),
    ("other", re.compile(r"(^|[^a-z])power([^a-z]|$)")),
    (
        "effort",
        re.compile(r"(^|[^a-z])(efforts?|torques?|tau|loads?|currents?|forces?)([^a-z]|$)"),
    ),
    (
        "velocity",
        re.compile(
            r"(^|[^a-z])(velocity|velocities|vel|qvel|dq|qd|speed|rate|omega|angular_velocity|"
            r"gyro|rpm|thetadot)([^a-z]|$)"
        ),
    ),
    (
        "position",
        re.compile(
            r"(^|[^a-z])(positions?|pos|qpos|q|angle|theta|alpha|phi|enc|encoder|height|yaw|heading|"
            r"observation[._]state|pose|deg)([^a-z]|$)"
        ),
    ),
    ("command", re.compile(r"^(.*[^a-z])?(motor|rotor|thrust|throttle|esc|servo)[^a-z]+$")),
)
"""What the names of signals usually mean, the first match first."""

_RATES = frozenset(("deg/s", "rad/s", "rpm"))
"""Units of rates, of which a name such as ``J1_deg [deg/s]`` has no position."""

_ROLES_OF_UNITS: dict[str, Role] = {"mm": "position", **dict.fromkeys(_RATES, "velocity")}
"""What a signal is by its unit if its name says nothing; metres can be a distance to anything."""


def role_of(name: str, unit: str = "") -> Role:
    """Returns what a signal probably is, by its name: a command before a position.

    Args:
        name: Its name.
        unit: Its unit, which decides if the name says nothing.
    """
    word = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    word = re.sub(r"\d+", "_", word)
    for role, pattern in _ROLES:
        if pattern.search(word):
            return "velocity" if role == "position" and unit in _RATES else role
    return _ROLES_OF_UNITS.get(unit, "other")


def plain_names(signals: Sequence[str]) -> list[str]:
    """Returns a name for each signal that every format can store, as short as they differ.

    Example: ``/joint_states/arm/position`` becomes ``arm_position``.
    """
    parts = [[p for p in re.split(r"[^A-Za-z0-9_]+", name) if p] or ["signal"] for name in signals]
    names = [""] * len(parts)
    used = set()
    for length in range(1, max((len(p) for p in parts), default=0) + 1):
        shortened = [_joined(p[-max(2, length) :]) for p in parts]
        for index, name in enumerate(shortened):
            if not names[index] and shortened.count(name) == 1 and name not in used:
                names[index] = name
                used.add(name)
    for index, name in enumerate(names):
        if not name:
            name, number = _joined(parts[index]), 2
            base = name
            while name in used:
                name, number = f"{base}_{number}", number + 1
            names[index] = name
            used.add(name)
    return names


def _joined(parts: Sequence[str]) -> str:
    name = "_".join(parts)[-80:].strip("_") or "signal"
    name = name if name[0].isalpha() else f"signal_{name}"
    return f"{name}_signal" if name in ("rollout", "time", "reward", "step") else name
