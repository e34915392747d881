"""Which signals of a log are a model's sensors and actions, by their names or their order."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.logs.inspection import SignalSummary
from npdr_ppl.rollouts.logs.signal_names import Role, role_of

__all__ = ["Column", "Match", "columns_of", "matched"]

_WITHOUT_MEANING = frozenset(
    "action actions actual angle angles cmd command commands control ctrl current data des "
    "desired feedback goal joint joints log measured motor observation pos position positions q "
    "qd qpos qvel dq reference servo setpoint speed state states target torque torques effort "
    "efforts u value values vel velocities velocity rad deg".split()
)
"""Words of a name that say what is measured or commanded, or nothing, but not at which joint."""

_RATES = frozenset(("rad/s", "m/s"))
"""Units of velocities."""


class Column(NamedTuple):
    """A column that a model reads.

    Attributes:
        name: Name of the model's sensor or action.
        unit: Its unit.
        role: What it is; the role of an action is ``"command"``.
    """

    name: str
    unit: str
    role: Role


class Match(NamedTuple):
    """The signal that a column probably is.

    Attributes:
        signal: The signal.
        is_by_order: Whether the order of the signals tells so; otherwise their names do.
    """

    signal: SignalSummary
    is_by_order: bool


def columns_of(sensors: Sequence[Channel], actions: Sequence[Channel]) -> list[Column]:
    """Returns the columns that a model reads: those of its sensors, then those of its actions."""
    return [
        *(Column(c.name, c.unit, _role_of_sensor(c)) for c in sensors),
        *(Column(c.name, c.unit, "command") for c in actions),
    ]


def _role_of_sensor(channel: Channel) -> Role:
    if channel.rate_of is not None or channel.unit in _RATES:
        return "velocity"
    if channel.unit in ("rad", "m"):
        return "position"
    role = role_of(channel.name)
    return "other" if role == "command" else role


def matched(columns: Sequence[Column], signals: Sequence[SignalSummary]) -> dict[str, Match]:
    """Returns the signals that a model's columns probably are, by the name of the column.

    Two names match if they have the same role and all words of the column's name that tell joints
    apart, such as ``shoulder`` of ``shoulder_command``, are among the words of the signal. Of
    several such signals, the one with the fewest other words is taken.

    Columns of a role that do not match are taken in the order of the log if there are as many
    signals of this role, and no name contradicts it. Numbers do not contradict, because some count
    joints from 0 and others from 1.

    Args:
        columns: The columns.
        signals: The signals, in the order of the log.
    """
    result = {}
    for role in dict.fromkeys(column.role for column in columns):
        wanted = [column for column in columns if column.role == role]
        own = [signal for signal in signals if signal.role == role]
        if role == "command" and not own:
            own = [signal for signal in signals if signal.role == "effort"]
        found = _by_name(wanted, own)
        if len(found) < len(wanted) == len(own):
            in_order = dict(zip([column.name for column in wanted], own, strict=True))
            names = [name for name in found if not "".join(_words(name)).isdigit()]
            if all(found[name] is in_order[name] for name in names):
                is_clear = len(wanted) == 1
                result |= {
                    name: Match(signal, is_by_order=not (is_clear or found.get(name) is signal))
                    for name, signal in in_order.items()
                }
                continue
        result |= {name: Match(signal, is_by_order=False) for name, signal in found.items()}
    return result


def _by_name(
    columns: Sequence[Column], signals: Sequence[SignalSummary]
) -> dict[str, SignalSummary]:
    """Returns the signals whose names match, without those that match several columns."""
    words = [_words(signal.name) for signal in signals]
    found = {}
    for column in columns:
        own = _words(column.name)
        extra = {k: sum((w - own).values()) for k, w in enumerate(words) if own <= w}
        least = [k for k, number in extra.items() if number == min(extra.values())]
        # A name such as "angle" tells no joints apart, so that it is no evidence beside others.
        if own and len(least) == 1:
            found[column.name] = least[0]
    times = Counter(found.values())
    return {name: signals[k] for name, k in found.items() if times[k] == 1}


def _words(name: str) -> Counter[str]:
    """Returns the words of a name that tell joints apart, in lower case."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
    words = re.findall(r"[a-z]+|\d+", name)
    return Counter(word for word in words if word not in _WITHOUT_MEANING)
