"""Data that are wrong, from rigs that are right: units, signs, alignment, lost samples."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hidden_rigs.hidden import Hidden
from hidden_rigs.plant import Layout
from npdr_ppl.rollouts import Rollouts

__all__ = ["FAULTS", "spoilt"]

Generator = np.random.Generator
Fault = Callable[[Rollouts, Layout, Generator], tuple[Rollouts, Hidden]]
"""Returns spoilt rollouts, and what was done to which channels."""


def spoilt(kind: str, rollouts: Rollouts, layout: Layout, seed: int) -> tuple[Rollouts, Hidden]:
    """Returns rollouts with a fault of some kind, the same in all of them.

    Args:
        kind: One of :data:`FAULTS`.
        rollouts: Sound rollouts.
        layout: Names of the channels.
        seed: What is drawn depends on it alone, so that other rollouts of the same device are
            spoilt in the same way.
    """
    return FAULTS[kind](rollouts, layout, np.random.default_rng(seed))


def _degrees(rollouts: Rollouts, layout: Layout, generator: Generator) -> tuple[Rollouts, Hidden]:
    """Positions and rates in degrees, or millimetres, that claim to be SI units."""
    units = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=True))
    turning = [name for name in layout.sensors if units[name].startswith("rad")]
    chosen = turning or list(layout.sensors)
    factor = 180.0 / np.pi if turning else 1000.0
    return _times(rollouts, chosen, factor), Hidden(
        ",".join(chosen), "wrong_unit", {"factor": factor}
    )


def _one_in_degrees(
    rollouts: Rollouts, layout: Layout, generator: Generator
) -> tuple[Rollouts, Hidden]:
    """One position, without its rate."""
    names = list(layout.positions)
    name = names[int(generator.integers(len(names)))]
    units = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=True))
    factor = 180.0 / np.pi if units[name] == "rad" else 1000.0
    return _times(rollouts, [name], factor), Hidden(name, "wrong_unit", {"factor": factor})


def _flipped(rollouts: Rollouts, layout: Layout, generator: Generator) -> tuple[Rollouts, Hidden]:
    """A joint whose position and rate have the wrong sign."""
    joint = int(generator.integers(len(layout.joints)))
    chosen = [layout.positions[joint], layout.velocities[joint]]
    return _times(rollouts, chosen, -1.0), Hidden(",".join(chosen), "wrong_sign")


def _flipped_action(
    rollouts: Rollouts, layout: Layout, generator: Generator
) -> tuple[Rollouts, Hidden]:
    """A command with the wrong sign."""
    action = int(generator.integers(len(layout.actions)))
    sign = np.ones(len(layout.actions))
    sign[action] = -1.0
    changed = replace(rollouts, actions=tuple(values * sign for values in rollouts.actions))
    return changed, Hidden(layout.actions[action], "wrong_sign")


def _misaligned(
    rollouts: Rollouts, layout: Layout, generator: Generator
) -> tuple[Rollouts, Hidden]:
    """Commands logged some steps late or early, as when two log files are put side by side."""
    shift = int(generator.integers(8, 20)) * (1 if generator.random() < 0.5 else -1)
    size = abs(shift)
    if shift > 0:  # the commands' file begins late
        readings = tuple(values[:-size] for values in rollouts.readings)
        actions = tuple(values[size:] for values in rollouts.actions)
    else:
        readings = tuple(values[size:] for values in rollouts.readings)
        actions = tuple(values[:-size] for values in rollouts.actions)
    return _again(rollouts, readings, actions), Hidden(
        ",".join(layout.actions), "misaligned", {"steps": float(shift)}
    )


def _dropped(rollouts: Rollouts, layout: Layout, generator: Generator) -> tuple[Rollouts, Hidden]:
    """Runs of samples lost here and there, the rest written one after the other."""
    readings, actions = [], []
    for values, commands in zip(rollouts.readings, rollouts.actions, strict=True):
        keep = np.ones(len(commands), dtype=bool)
        for _ in range(6):
            first = int(generator.integers(20, len(commands) - 40))
            keep[first : first + int(generator.integers(3, 12))] = False
        readings.append(values[np.append(keep, True)])
        actions.append(commands[keep])
    return _again(rollouts, tuple(readings), tuple(actions)), Hidden(
        ",".join(layout.sensors), "dropped_samples"
    )


def _times(rollouts: Rollouts, channels: list[str], factor: float) -> Rollouts:
    """Returns rollouts with some channels multiplied."""
    factors = np.array([factor if name in channels else 1.0 for name in rollouts.channel_names])
    return replace(rollouts, readings=tuple(values * factors for values in rollouts.readings))


def _again(
    rollouts: Rollouts, readings: tuple[np.ndarray, ...], actions: tuple[np.ndarray, ...]
) -> Rollouts:
    """Returns rollouts of other lengths, their time stamps counted from zero again."""
    return replace(rollouts, readings=readings, actions=actions, time=())


FAULTS: dict[str, Fault] = {
    "degrees": _degrees,
    "one_in_degrees": _one_in_degrees,
    "flipped": _flipped,
    "flipped_action": _flipped_action,
    "misaligned": _misaligned,
    "dropped": _dropped,
}
"""Faults by kind."""
