"""Says which signal of a log is which channel or action of the rollouts, and in which unit.

A mapping is a TOML file::

    [log]
    time_unit = "us"

    [channels.arm_angle]
    signal = "/joint_states/joint0/position"
    unit = "deg"
    sign = -1

    [actions.voltage]
    signal = "/voltage/data"
"""

import math
import re
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.registry import hint
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.assemble import rollouts_of
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.logs.nearest_names import missing
from npdr_ppl.rollouts.logs.unit_remarks import rates_without_unit, unknown_units
from npdr_ppl.rollouts.logs.units import si_unit
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording

__all__ = ["Mapping", "SignalMapping", "settings_lines", "toml_key", "toml_text"]

MAX_BYTES = 2**16
"""Largest mapping in bytes; one of fifty joints takes a tenth of it."""


class SignalMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a channel or an action comes from.

    Its value is ``sign · scale · signal + offset``, with the signal converted to SI.

    Attributes:
        signal: Name of the signal in the log.
        unit: Unit of the signal, e.g. ``"deg"``; ``""`` for the unit that the log states. A unit
            that is not known is kept.
        sign: ``-1`` turns the direction around.
        scale: Factor without a unit, e.g. of a gear.
        offset: What to add, in the SI unit.
        first_turn: Whether whole turns of a measured angle are then subtracted, so that the log,
            though not each of its rollouts, begins between −π and π. An encoder counts on when a
            joint turns, and laws such as springs are no periodic functions of the angle.
    """

    signal: str
    unit: str = ""
    sign: int = 1
    scale: float = 1.0
    offset: float = 0.0
    first_turn: bool = False


class Mapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How rollouts are made of a log.

    Attributes:
        log: How the log is read.
        channels: What was measured, by the name of the channel.
        actions: What was commanded, by the name of the action; none for free motion.
    """

    log: LogSettings = LogSettings()
    channels: dict[str, SignalMapping] = {}
    actions: dict[str, SignalMapping] = {}

    @classmethod
    def of(cls, mapping: "Mapping | dict[str, Any] | str | PathLike[str]") -> "Mapping":
        """Returns a mapping from a file, a dictionary, or a mapping itself.

        Raises:
            DataError: It is not a valid mapping; the message says why in one sentence.
        """
        if isinstance(mapping, Mapping):
            return mapping
        if isinstance(mapping, dict):
            return _checked(mapping)
        if not isinstance(mapping, str | PathLike):
            raise DataError(
                f"a mapping is a TOML file, a dictionary or a Mapping, not a "
                f"{type(mapping).__name__}."
            )
        path = rollout_checks.check_file(mapping)
        with rollout_checks.named(path):
            if path.stat().st_size > MAX_BYTES:
                raise DataError(f"it has more than {MAX_BYTES} bytes.")
            try:
                content = tomllib.loads(path.read_bytes().decode())
            except UnicodeDecodeError:
                raise DataError("it is not UTF-8 text.") from None
            except tomllib.TOMLDecodeError as error:
                raise DataError(f"it is not valid TOML ({_plain(str(error))}).") from None
            except ValueError:
                raise DataError("it is not valid TOML (a number is too long).") from None
            except RecursionError:
                raise DataError("its tables are nested too deeply.") from None
            return _checked(content)

    def write(self, path: str | PathLike[str]) -> None:
        """Writes the mapping as a TOML file."""
        with replacing(path) as temporary:
            Path(temporary).write_text(self.toml(), encoding="utf-8")

    def toml(self) -> str:
        """Returns the mapping as TOML."""
        lines = []
        if given := settings_lines(self.log):
            lines += ["[log]", *given.values(), ""]
        for section, entries in (("channels", self.channels), ("actions", self.actions)):
            for name, entry in entries.items():
                lines.append(f"[{section}.{toml_key(name)}]")
                default = SignalMapping("")
                for field, value in msgspec.structs.asdict(entry).items():
                    if field == "signal" or value != getattr(default, field):
                        lines.append(f"{field} = {toml_text(value)}")
                lines.append("")
        return "\n".join(lines)

    def apply(self, log: Log) -> Recording:
        """Makes rollouts of a log.

        Args:
            log: The log, read with the settings of :attr:`log`.

        Raises:
            DataError: A signal is missing, or too little was recorded.
        """
        with rollout_checks.named(log.source):
            if not self.channels:
                raise DataError(
                    "the mapping has no channels; each needs a table such as [channels.angle] "
                    "with the key signal."
                )
            episodes = log.episodes if self.log.episodes is None else self.log.episodes
            recording = rollouts_of(
                [_converted(log, *entry) for entry in self.channels.items()],
                [_converted(log, *entry) for entry in self.actions.items()],
                episodes=_found(log, episodes) if episodes else None,
                time_step=self.log.time_step,
            )
            told = [*self._unit_remarks(log), *self._shared_signals()]
            return replace(recording, notes=(*log.notes, *told, *recording.notes))

    def _shared_signals(self) -> list[Remark]:
        """Returns which channels are the same signal, a sentence for each such signal."""
        by_signal: dict[str, list[str]] = {}
        for name, entry in self.channels.items():
            by_signal.setdefault(entry.signal, []).append(name)
        return [
            Remark(f"{' and '.join(names)} are the same signal of the log, {signal}.")
            for signal, names in by_signal.items()
            if len(names) > 1
        ]

    def _unit_remarks(self, log: Log) -> list[Remark]:
        """Returns what looks wrong about the units of channels and actions, a sentence each."""
        entries = {**self.channels, **self.actions}
        stated = [
            (name, entry.signal, entry.unit or log.by_name[entry.signal].unit)
            for name, entry in entries.items()
        ]
        return [*unknown_units(stated), *rates_without_unit(stated)]


def _found(log: Log, name: str) -> Signal:
    if name not in log.by_name:
        raise DataError(missing("signal", name, log.by_name))
    return log.by_name[name]


def _converted(log: Log, name: str, entry: SignalMapping) -> Signal:
    """Returns the signal of a channel or an action, in its SI unit."""
    signal = _found(log, entry.signal)
    factor, unit = si_unit(entry.unit or signal.unit)
    values = signal.values
    if (factor, entry.sign, entry.scale, entry.offset) != (1.0, 1, 1.0, 0.0):
        with np.errstate(over="ignore", invalid="ignore"):
            values = entry.sign * entry.scale * (values * factor) + entry.offset
    if entry.first_turn:
        if unit != "rad":
            raise DataError(
                f"first_turn of {name} needs an angle; give the signal a unit such as 'rad'."
            )
        begin = values[np.isfinite(values)][:1]
        values = values - 2.0 * np.pi * np.round(begin.sum() / (2.0 * np.pi))
    return Signal(name, signal.time, values, unit)


def _checked(content: dict[str, Any]) -> Mapping:
    """Returns a mapping after checking its keys, types and numbers."""
    _check_keys(content, Mapping, "")
    _check_keys(content.get("log"), LogSettings, "log")
    for section in ("channels", "actions"):
        entries = content.get(section)
        if isinstance(entries, dict):
            if len(entries) > LIMITS.columns:
                raise DataError(f"[{section}] has more than {LIMITS.columns} entries.")
            for name, entry in entries.items():
                if not isinstance(entry, dict | SignalMapping):
                    raise DataError(
                        f"{rollout_checks.shown(name)} in [{section}] should be a table such as "
                        f"[{section}.{toml_key(str(name)[:40])}] with the key signal."
                    )
                _check_keys(entry, SignalMapping, f"{section}.{str(name)[:40]}")
    try:
        mapping = msgspec.convert(content, Mapping)
    except msgspec.ValidationError as error:
        raise DataError(f"the mapping is not valid: {_plain(str(error))}.") from None
    rollout_checks.check_names([*mapping.channels, *mapping.actions])
    for name, entry in {**mapping.channels, **mapping.actions}.items():
        if entry.sign not in (-1, 1):
            raise DataError(f"sign of {name} is {entry.sign}, but it should be 1 or -1.")
        for field in ("scale", "offset"):
            value = getattr(entry, field)
            if not abs(value) < rollout_checks.MAX_MAGNITUDE:
                raise DataError(f"{field} of {name} is {value}, but it should be finite.")
        if entry.first_turn and name in mapping.actions:
            raise DataError(
                f"first_turn of {name} is for measured angles; a goal that is shifted alone would "
                "be whole turns away from them. Give it an offset."
            )
        if entry.scale == 0:
            raise DataError(f"scale of {name} is 0, which removes the signal.")
    rollout_checks.check_unit_texts(
        [e.unit for e in (*mapping.channels.values(), *mapping.actions.values())],
        [*mapping.channels, *mapping.actions],
    )
    step = mapping.log.time_step
    if step is not None and not (math.isfinite(step) and step > 0):
        raise DataError(f"time_step is {step} s, but it should be positive.")
    return mapping


def _check_keys(content: Any, kind: type[msgspec.Struct], where: str) -> None:
    known: Iterable[str] = kind.__struct_fields__
    for key in content if isinstance(content, dict) else ():
        if key not in known:
            place = f"[{where}]" if where else "the mapping"
            raise DataError(
                f"{place} has no key {rollout_checks.shown(key)}; {hint(str(key)[:100], known)}"
            )


def _plain(message: str) -> str:
    """Returns another library's message as part of a sentence."""
    line = " ".join(message.split()).rstrip(".")[:200]
    line = re.sub(r"\. (?=[A-Z])", "; ", line)
    return line if line.isprintable() else ascii(line)


def toml_key(name: str) -> str:
    """Returns a name as a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_text(name)


def settings_lines(settings: LogSettings) -> dict[str, str]:
    """Returns the lines of the table ``[log]`` in TOML, by key."""
    given = {k: v for k, v in msgspec.structs.asdict(settings).items() if v is not None}
    return {key: f"{key} = {toml_text(value)}" for key, value in given.items()}


def toml_text(value: object) -> str:
    """Returns a value in TOML: text, a number or a truth value."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    escaped = []
    for letter in str(value):
        if letter in '"\\':
            escaped.append(f"\\{letter}")
        elif letter.isprintable():
            escaped.append(letter)
        else:
            escaped.append(f"\\U{ord(letter):08x}")
    return f'"{"".join(escaped)}"'
