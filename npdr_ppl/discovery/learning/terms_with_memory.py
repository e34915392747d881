"""Terms that depend on the past motion or commands, or whose constants must be scanned."""

import math
from collections.abc import Iterator

import torch

from npdr_ppl.discovery.learning.memory import (
    DELAY,
    HYSTERESIS,
    LAG,
    RELAXATION,
    RESONANCE,
    UNEVEN_HYSTERESIS,
    Memory,
)
from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.learning.term import Shape, Term

__all__ = ["remembering_commands", "remembering_forces", "series_at"]


def remembering_forces(motion: PortMotion) -> Iterator[Term]:
    """Returns forces that depend on the past motion."""
    q, v, unit = motion.values["q"], motion.values["v"], motion.units["q"]
    step = motion.time_step * float(v.square().mean().sqrt())
    span = float(q.max() - q.min())
    if not 0.0 < LEARNING.narrowest_hysteresis * step < span:
        return
    num = 2 * LEARNING.num_shapes
    for width in _logarithmic(LEARNING.narrowest_hysteresis * step, span, num):
        wide = Shape("width", width, unit)
        yield _with_memory(HYSTERESIS, "bend", "b", "1", {"q", "v"}, wide)
        uneven = Shape("asymmetry", LEARNING.asymmetry, "1")
        yield _with_memory(UNEVEN_HYSTERESIS, "bend", "b", "1", {"q", "v"}, wide, uneven)
    longest = motion.interval * max(1, motion.past.shape[1])
    shortest = LEARNING.shortest_relaxation * motion.time_step
    if shortest < longest:
        for time in _logarithmic(shortest, longest, LEARNING.num_shapes):
            constant = Shape("time_constant", time, "s")
            yield _with_memory(RELAXATION, "stretch", "r", unit, {"q", "v"}, constant)


def remembering_commands(motion: PortMotion) -> Iterator[Term]:
    """Returns the changes of a command by a lag and by a delay."""
    unit, step = motion.units["u"], motion.time_step
    num = 2 * LEARNING.num_shapes
    for time in _logarithmic(0.3 * step, LEARNING.longest_lag * step, num):
        constant = Shape("time_constant", time, "s")
        yield _with_memory(LAG, "output - u", "(z − u)", unit, {"u"}, constant)
    for time in _logarithmic(0.3 * step, LEARNING.longest_lag * step, num):
        constant = Shape("delay", time, "s")
        yield _with_memory(DELAY, "late - u", "(u(t − d) − u)", unit, {"u"}, constant)


def _logarithmic(low: float, high: float, num: int) -> list[float]:
    return torch.logspace(math.log10(low), math.log10(high), num, dtype=torch.float64).tolist()


def _with_memory(
    memory: Memory, column: str, formula: str, unit: str, uses: set[str], *shapes: Shape
) -> Term:
    """Returns a term with a state, whose own complexity counts as one operation."""
    values = "".join(f" {shape.value:.6g}" for shape in shapes)
    return Term(
        f"{formula} {memory.equation}{values}",
        (column,),
        (formula,),
        (unit,),
        frozenset(uses),
        shapes,
        memory=memory,
        cost=2.0 + len(shapes) + column.count("-"),
    )


def series_at(motion: PortMotion) -> list[Term]:
    """Returns terms of which only the strongest are combined with others.

    Their constant must be known too closely for a few values of it: the frequency of a wave in
    time at a joint, and the time constant of a resonance at a command. An elastic joint is such a
    resonance: it changes the force that the motor passes on to the link.

    Args:
        motion: The motion at the port.
    """
    if motion.port.kind == "force":
        # A rollout cannot tell waves apart that differ by less than half a period in all.
        longest = float(motion.values["t"].max())
        width = float((motion.edges[1:] - motion.edges[:-1]).min()) * motion.time_step
        most = min(LEARNING.most_frequencies, int(longest / width))
        return [_wave_in_time(0.5 * k / longest) for k in range(1, most + 1)]
    if motion.port.kind == "sensor":
        return []
    ends = 0.2 * motion.time_step, 0.5 * LEARNING.longest_lag * motion.time_step
    damping, found = Shape("damping", LEARNING.damping, "1"), []
    for time in _logarithmic(*ends, LEARNING.num_resonances):
        own = Shape("time_constant", time, "s"), damping
        unit = motion.units["u"]
        found.append(_with_memory(RESONANCE, "ring - u", "(z − u)", unit, {"u"}, *own))
    return found


def _wave_in_time(frequency: float) -> Term:
    """Returns sine and cosine of the time since a rollout began, for a frequency in Hz."""
    angle = f"{2.0 * math.pi!r} * frequency * t"
    return Term(
        f"sin(2π f t) + cos(2π f t) {frequency:.6g}",
        (f"torch.sin({angle})", f"torch.cos({angle})"),
        ("sin(2π f t)", "cos(2π f t)"),
        ("1", "1"),
        frozenset({"t"}),
        (Shape("frequency", frequency, "Hz"),),
        cost=4.0,
    )
