"""What a robot may do in the next recording: a TOML file, completed by defaults."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.planning.settings import PLANNING

__all__ = ["ActionLimits", "ChannelLimits", "Limits", "default_limits", "read_limits"]

MOST_BYTES = 1_000_000
"""Longest file in bytes; a robot of a hundred joints needs a hundredth of it."""

MOST_STEPS = 100_000
"""Greatest number of commands of a recording: 100 s at 1 kHz. The simulations of a batch with 14
channels and four causes then take 1.6 GB of memory."""

Part = TypeVar("Part", "ActionLimits", "ChannelLimits")


@dataclass(frozen=True)
class ActionLimits:
    """Limits of one command, in its unit; those of a servo's goal are those of the goal.

    Attributes:
        min: Least command.
        max: Greatest command.
        max_rate: Greatest change per second.
        max_acceleration: Greatest change of the rate per second.
        start: Command at the beginning and at the end.
    """

    min: float
    max: float
    max_rate: float = math.inf
    max_acceleration: float = math.inf
    start: float = 0.0


@dataclass(frozen=True)
class ChannelLimits:
    """Limits of one measured channel, in its unit, along the simulated motion.

    Attributes:
        min: Least value.
        max: Greatest value.
        max_rate: Greatest change per second: of an angle, the speed.
        max_acceleration: Greatest change of the rate per second.
        start_min: Least value from which the robot can be released at rest.
        start_max: Greatest one.
        noise: Standard deviation of the measurement.
    """

    min: float = -math.inf
    max: float = math.inf
    max_rate: float = math.inf
    max_acceleration: float = math.inf
    start_min: float = 0.0
    start_max: float = 0.0
    noise: float = math.nan


@dataclass(frozen=True)
class Limits:
    """What the robot may do.

    Attributes:
        duration: Length of the recording in seconds.
        bandwidth: Greatest frequency of the commands in Hz.
        time_step: Seconds per command.
        actions: Limits by command.
        channels: Limits by measured channel.
    """

    duration: float
    bandwidth: float
    time_step: float
    actions: dict[str, ActionLimits]
    channels: dict[str, ChannelLimits]

    @property
    def num_steps(self) -> int:
        """Number of commands."""
        return round(self.duration / self.time_step)

    def toml(self, units: Mapping[str, str]) -> str:
        """Returns the limits as TOML; those that are infinite are left out.

        Args:
            units: Units by command and channel, for the comments.
        """
        lines = [
            # With all digits: a rounded bandwidth may be less than one period of the duration.
            f"duration = {float(self.duration)!r}  # s",
            f"bandwidth = {float(self.bandwidth)!r}  # Hz",
            f"time_step = {float(self.time_step)!r}  # s",
        ]
        for section, parts in (("actions", self.actions), ("channels", self.channels)):
            for name, part in parts.items():
                lines += ["", f"[{section}.{_key(name)}]  # {units.get(name, '')}".rstrip(" #")]
                lines += [
                    f"{key} = {value:.6g}"
                    for key, value in asdict(part).items()
                    if math.isfinite(value)
                ]
        return "\n".join([*lines, ""])


def default_limits(
    simulator: Simulator,
    recorded: Mapping[str, Any] | None,
    *,
    time_step: float | None = None,
    noise: Mapping[str, float] | None = None,
) -> Limits:
    """Returns limits that the recording kept, or, without one, those that the model declares.

    Args:
        simulator: The model's simulator.
        recorded: ``surviving_causes`` of a discovery; ``None`` without a recording.
        time_step: Seconds per step of a fitted recording; ``None`` for the model's.
        noise: Standard deviation of the channels that were measured in it; empty or ``None`` for
            the usual noise of all sensors.

    Raises:
        DataError: A command has no limits.
    """
    if recorded is not None:
        return _of_recording(simulator, recorded)
    channels = {s.name: _declared(simulator, s) for s in simulator.sensors}
    if noise:
        channels = {
            name: replace(channel, noise=noise[name])
            for name, channel in channels.items()
            if name in noise
        }
    return Limits(
        PLANNING.prior_seconds,
        PLANNING.prior_bandwidth,
        time_step or simulator.time_step,
        {
            a.name: ActionLimits(a.lower, a.upper, start=_nearest_zero(a))
            for a in simulator.actions
        },
        channels,
    )


def _of_recording(simulator: Simulator, recorded: Mapping[str, Any]) -> Limits:
    """Returns the ranges of a recording, of those columns that the model has."""
    actions = {}
    for action in simulator.actions:
        kept = recorded["actions"][action.name]
        # A goal begins where the servo is; a force begins at zero.
        start = kept["start_min"] if simulator.is_goal(action.name) else _inside(0.0, kept)
        # A command that was constant has no rate, which a file could not name.
        rate = kept["max_rate"] or math.inf
        actions[action.name] = ActionLimits(kept["min"], kept["max"], rate, start=start)
    channels = {}
    for sensor in simulator.sensors:
        if sensor.name in recorded["channels"]:
            kept = recorded["channels"][sensor.name]
            is_rate = sensor.rate_of is not None
            channels[sensor.name] = ChannelLimits(
                kept["min"],
                kept["max"],
                start_min=0.0 if is_rate else kept["start_min"],
                start_max=0.0 if is_rate else kept["start_max"],
                noise=recorded["noise"].get(sensor.name, math.nan),
            )
    duration = min(float(recorded["seconds"]), PLANNING.most_seconds)
    bandwidths = [recorded["actions"][name]["bandwidth"] for name in actions]
    return Limits(
        duration,
        max([1.0 / duration, *bandwidths]),
        float(recorded["time_step"]),
        actions,
        channels,
    )


def read_limits(path: Path | None, defaults: Limits) -> Limits:
    """Reads a file of limits; what it does not name has its default.

    Args:
        path: The TOML file; ``None`` for the defaults.
        defaults: The defaults.

    Raises:
        DataError: The file is bad, or a command has no limits.
    """
    if path is None:
        return _checked(defaults, "The limits")
    try:
        if path.stat().st_size > MOST_BYTES:
            raise DataError(
                f"{path} has more than {MOST_BYTES} bytes, so it is no file of limits."
            )
        content = tomllib.loads(path.read_bytes().decode())
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} is not valid TOML ({error}).") from None
    known = {field.name for field in fields(Limits)}
    _check_keys(content, known, str(path))
    numbers = {
        key: _number(content[key], f"{key} in {path}", least=0.0)
        for key in ("duration", "bandwidth", "time_step")
        if key in content
    }
    limits = replace(
        defaults,
        **numbers,
        actions=_parts(content.get("actions", {}), defaults.actions, "actions", path),
        channels=_parts(content.get("channels", {}), defaults.channels, "channels", path),
    )
    return _checked(limits, str(path))


def _parts(given: Any, defaults: Mapping[str, Part], section: str, path: Path) -> dict[str, Part]:
    """Returns the limits of a section of a file, by name."""
    if not isinstance(given, dict):
        raise DataError(f"{section} in {path} is no table; write [{section}.NAME].")
    _check_keys(given, defaults, f"[{section}] in {path}")
    result = dict(defaults)
    for name, values in given.items():
        place = f"[{section}.{name}] in {path}"
        if not isinstance(values, dict):
            raise DataError(f"{place} is no table of limits.")
        _check_keys(values, {field.name for field in fields(result[name])}, place)
        positive = ("max_rate", "max_acceleration", "noise")
        numbers = {
            key: _number(value, f"{key} of {place}", least=0.0 if key in positive else -math.inf)
            for key, value in values.items()
        }
        if "start" in {field.name for field in fields(result[name])} and "start" not in numbers:
            ends = {"min": result[name].min, "max": result[name].max} | numbers
            numbers["start"] = _inside(getattr(result[name], "start", 0.0), ends)
        result[name] = replace(result[name], **numbers)
    return result


def _checked(limits: Limits, place: str) -> Limits:
    """Returns limits that can be kept, or raises a DataError that says which cannot."""
    for name, action in limits.actions.items():
        if not (math.isfinite(action.min) and math.isfinite(action.max)):
            raise DataError(
                f"{place}: {name} has no greatest command; write min and max below "
                f"[actions.{name}]."
            )
        if action.min > action.max:
            raise DataError(f"{place}: min of {name} is above its max.")
        if not action.min <= action.start <= action.max:
            raise DataError(f"{place}: start of {name} is not between its min and max.")
    for name, channel in limits.channels.items():
        if not channel.min < channel.max:
            raise DataError(
                f"{place}: min of {name} must be below max, {channel.max:g}; write both below "
                f"[channels.{name}]."
            )
        for key in ("start_min", "start_max", "noise"):
            if math.isinf(getattr(channel, key)):
                raise DataError(f"{place}: {key} of {name} must be finite.")
        if channel.start_min > channel.start_max:
            raise DataError(f"{place}: start_min of {name} is above its start_max.")
        if channel.start_min < channel.min or channel.start_max > channel.max:
            raise DataError(f"{place}: {name} may start outside its min and max.")
    if limits.duration / limits.time_step > MOST_STEPS:
        raise DataError(
            f"{place}: a duration of {limits.duration:g} s has more than {MOST_STEPS} steps of "
            f"{limits.time_step:g} s; plan a shorter recording."
        )
    if limits.num_steps < 50:
        raise DataError(
            f"{place}: a duration of {limits.duration:g} s has {limits.num_steps} steps of "
            f"{limits.time_step:g} s; at least 50 are needed."
        )
    if not 1.0 / limits.duration <= limits.bandwidth <= 0.5 / limits.time_step:
        raise DataError(
            f"{place}: the bandwidth of {limits.bandwidth:g} Hz must lie between one period of "
            f"the duration, {1.0 / limits.duration:.3g} Hz, and half the sampling rate, "
            f"{0.5 / limits.time_step:.4g} Hz."
        )
    return limits


def _check_keys(content: Mapping[str, Any], known: Any, place: str) -> None:
    unknown = sorted(set(content) - set(known))
    if unknown:
        raise DataError(f"{place} has {unknown[0]!r}; known are {', '.join(known)}.")


def _number(value: Any, name: str, *, least: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise DataError(f"{name} is {value!r}, which is not a number.")
    if value <= least and math.isfinite(least):
        raise DataError(f"{name} is {value:g}; it must be above {least:g}.")
    return float(value)


def _inside(value: float, ends: Mapping[str, float]) -> float:
    return min(max(value, ends["min"]), ends["max"])


def _nearest_zero(channel: Channel) -> float:
    """Returns the value in a channel's range that is closest to zero."""
    return _inside(0.0, {"min": channel.lower, "max": channel.upper})


def _declared(simulator: Simulator, sensor: Channel) -> ChannelLimits:
    """Returns what a model declares of a channel."""
    ports = [port for port in simulator.ports if port.name == sensor.name]
    rated = ports[0].rated if ports else 1.0
    start = _nearest_zero(sensor)
    return ChannelLimits(
        sensor.lower,
        sensor.upper,
        start_min=start,
        start_max=start,
        noise=PLANNING.relative_noise * rated,
    )


def _key(name: str) -> str:
    is_bare = name.replace("_", "").replace("-", "").isalnum() and name.isascii()
    return name if is_bare else '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
