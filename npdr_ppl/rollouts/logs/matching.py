"""Which signals of a log are a model's sensors and actions, by their names or their order."""

import re
from collections import Counter
from collections.abc import Container, Sequence
from typing import NamedTuple

from npdr_ppl.language.channels import Channel, Follower, Spin
from npdr_ppl.rollouts.logs.inspection import SignalSummary
from npdr_ppl.rollouts.logs.pose_names import FRAMES, pose_part, pose_parts
from npdr_ppl.rollouts.logs.signal_names import Role, role_of

__all__ = ["Column", "Match", "can_be_left_out", "columns_of", "matched"]

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
        rate_of: The position whose rate it is; ``None`` for others.
        follows: The position that it follows from; ``None`` for others.
        leads: The position that follows from it, and the other way round; ``None`` for others.
    """

    name: str
    unit: str
    role: Role
    rate_of: str | None = None
    follows: str | None = None
    leads: str | None = None


class Match(NamedTuple):
    """The signal that a column probably is.

    Attributes:
        signal: The signal.
        doubt: Why this should be checked, ``""`` if the names agree.
    """

    signal: SignalSummary
    doubt: str


def columns_of(
    sensors: Sequence[Channel],
    actions: Sequence[Channel],
    followers: Sequence[Follower | Spin] = (),
) -> list[Column]:
    """Returns the columns that a model reads: those of its sensors, then those of its actions.

    Args:
        sensors: The model's sensors.
        actions: Its actions.
        followers: Positions that follow from others. Of two that follow from each other, the
            first one follows.
    """
    follows: dict[str, str] = {}
    for follower in followers:
        if follower.name not in follows and follower.leader not in follows:
            follows[follower.name] = follower.leader
    pairs = {(follower.name, follower.leader) for follower in followers}
    leads = {leader: name for name, leader in follows.items() if (leader, name) in pairs}
    return [
        *(
            Column(
                c.name,
                c.unit,
                _role_of_sensor(c),
                c.rate_of,
                follows.get(c.name),
                leads.get(c.name),
            )
            for c in sensors
        ),
        *(Column(c.name, c.unit, "command") for c in actions),
    ]


def can_be_left_out(
    column: Column, columns: Sequence[Column], present: Container[str | None]
) -> bool:
    """Returns whether a column is not needed beside others that are present.

    Args:
        column: The column.
        columns: All columns of the model.
        present: Names of those that are present.
    """
    position = next((c for c in columns if c.name == column.rate_of), column)
    known = {column.rate_of, position.follows, position.leads} - {None}
    return any(name in present for name in known)


def _role_of_sensor(channel: Channel) -> Role:
    if channel.rate_of is not None or channel.unit in _RATES:
        return "velocity"
    if channel.unit in ("rad", "m"):
        return "position"
    role = role_of(channel.name)
    return "other" if role == "command" else role


def matched(columns: Sequence[Column], signals: Sequence[SignalSummary]) -> dict[str, Match]:
    """Returns the signals that a model's columns probably are, by the name of the column.

    A signal with the name of a column is that column. Two other names match if they have the same
    role and all words of the column's name that tell joints apart, such as ``shoulder`` of
    ``shoulder_command``, are among the words of the signal. Of several such signals, the one with
    the fewest other words is taken.

    Columns of a role that do not match are taken in the order of the log if there are as many
    signals of this role, and no name contradicts it; those that follow from others do not count if
    there is no signal for them. Numbers do not contradict, because some count joints from 0 and
    others from 1. A measurement that never changes is no match. Positions and velocities that are
    left can match signals whose role their names do not tell. Of a model of one floating body,
    names such as ``qw`` and ``gyro_x`` tell parts of the pose.

    Args:
        columns: The columns.
        signals: The signals, in the order of the log.
    """
    by_name = {signal.name: signal for signal in signals}
    result = {
        column.name: Match(signal, "")
        for column in columns
        if (signal := by_name.get(column.name)) is not None
        and (column.role == "command" or not signal.is_constant)
    }
    result |= _of_a_pose(columns, signals, result)
    taken = {match.signal.name for match in result.values()}
    columns = [column for column in columns if column.name not in result]
    signals = [signal for signal in signals if signal.name not in taken]
    for role in dict.fromkeys(column.role for column in columns):
        wanted = [column for column in columns if column.role == role]
        own = [s for s in signals if s.role == role and (role == "command" or not s.is_constant)]
        leading = _measured(wanted, own)
        wanted = leading if len(own) == len(leading) else wanted
        doubt = ""
        if role == "command" and not own:
            taken = {match.signal.name for match in result.values()}
            own = [s for s in signals if s.role == "effort" and s.name not in taken]
            doubt = "may be a measurement"
        result |= _of_one_role(wanted, _in_order(own), doubt)
    taken = {match.signal.name for match in result.values()}
    left = [c for c in columns if c.name not in result and c.role in ("position", "velocity")]
    unclear = [
        s for s in signals if s.role == "other" and not s.is_constant and s.name not in taken
    ]
    found = _by_name(left, unclear)
    doubt = "its name does not say what it measures"
    return result | {name: Match(signal, doubt) for name, signal in found.items()}


def _measured(columns: Sequence[Column], signals: Sequence[SignalSummary]) -> list[Column]:
    """Returns the columns without those that follow from others.

    Of two that follow from each other, as the fingers of a gripper, the one that a signal names is
    measured.
    """
    named = _by_name(columns, signals)
    by_name = {column.name: column for column in columns}
    instead = {
        column.name: by_name[column.leads]
        for column in columns
        if column.leads in by_name and column.leads in named and column.name not in named
    }
    return [instead.get(column.name, column) for column in columns if column.follows is None]


def _of_a_pose(
    columns: Sequence[Column], signals: Sequence[SignalSummary], known: Container[str]
) -> dict[str, Match]:
    """Returns the signals that are parts of the pose and velocity of a model's floating body.

    Args:
        columns: The columns.
        signals: The signals.
        known: Names of the columns whose signals are known.
    """
    columns = [column for column in columns if column.role != "command"]
    parts = pose_parts([column.name for column in columns])
    if [part for part in parts.values() if part[0] == "orientation"] != [
        ("orientation", axis) for axis in "wxyz"
    ]:
        return {}
    by_part: dict[tuple[str, str], list[SignalSummary]] = {}
    for signal in signals:
        if signal.is_constant or signal.role == "command" or signal.name in known:
            continue
        if (part := pose_part(signal.name)) is not None:
            by_part.setdefault(part, []).append(signal)
    return {
        name: Match(by_part[part][0], f"check that it is {FRAMES[part[0]]}")
        for name, part in parts.items()
        if name not in known and len(by_part.get(part, ())) == 1
    }


def _of_one_role(
    columns: Sequence[Column], signals: Sequence[SignalSummary], doubt: str
) -> dict[str, Match]:
    """Returns the signals that columns probably are; all have the same role.

    Args:
        columns: The columns.
        signals: The signals, in their order.
        doubt: What to check in any case.
    """
    found = _by_name(columns, signals)
    numbered = {name for name in found if "".join(_words(name)).isdigit()}
    if len(found) < len(columns) == len(signals) and columns[0].role != "other":
        in_order = dict(zip([column.name for column in columns], signals, strict=True))
        if all(found[name] is in_order[name] for name in found.keys() - numbered):
            found, unsure = in_order, in_order.keys() - (found.keys() - numbered)
            (first, *others) = columns
            is_clear = not others and not (_words(first.name) and _words(signals[0].name))
            place = "" if is_clear else "by its place among the others"
            return {
                name: Match(signal, doubt or (place if name in unsure else ""))
                for name, signal in found.items()
            }
    by_number = "by its number; some count from 0" if len(found) < len(signals) else ""
    return {
        name: Match(signal, doubt or (by_number if name in numbered else ""))
        for name, signal in found.items()
    }


def _by_name(
    columns: Sequence[Column], signals: Sequence[SignalSummary]
) -> dict[str, SignalSummary]:
    """Returns the signals whose names match; of columns that share one, the closest gets it."""
    words = [_words(signal.name) for signal in signals]
    found: dict[str, tuple[int, int]] = {}  # signal, and number of its words that do not match
    for column in columns:
        own = _words(column.name)
        extra = {k: sum((w - own).values()) for k, w in enumerate(words) if own <= w}
        least = [k for k, number in extra.items() if number == min(extra.values())]
        # A name such as "angle" tells no joints apart, so that it is no evidence beside others.
        if own and len(least) == 1:
            found[column.name] = least[0], extra[least[0]]
    by_signal: dict[int, list[tuple[int, str]]] = {}
    for name, (k, number) in found.items():
        by_signal.setdefault(k, []).append((number, name))
    result = {}
    for k, claims in by_signal.items():
        (number, name), *others = sorted(claims)
        if not others or number < others[0][0]:
            result[name] = signals[k]
    return result


def _in_order(signals: Sequence[SignalSummary]) -> list[SignalSummary]:
    """Returns signals in their order; by number if their names differ in nothing else.

    Columns in alphabetical order have ``q10`` before ``q2``.
    """
    if len({re.sub(r"\d+", "", signal.name) for signal in signals}) != 1:
        return list(signals)
    return sorted(signals, key=lambda signal: [int(n) for n in re.findall(r"\d+", signal.name)])


def _words(name: str) -> Counter[str]:
    """Returns the words of a name that tell joints apart, in lower case."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
    words = re.findall(r"[a-z]+|\d+", name)
    return Counter(word for word in words if word not in _WITHOUT_MEANING)
