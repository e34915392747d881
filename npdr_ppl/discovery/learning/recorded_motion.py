"""What a missing law may depend on, recorded at every port along the simulated motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.screening.latent_force import Pulse
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import ActionEffect, Commands, ForceEffect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.segment_model import SegmentModel

__all__ = ["PortMotion", "motion_at_ports"]


class _Recorder(ForceEffect):
    """No force: it keeps the state of its joint at every step."""

    id = "recorder"
    needs_joint = True
    needs_past = True
    parameters = (Parameter("nothing", "1", 0.0, "not used"),)

    def __init__(self, port: str) -> None:
        super().__init__(port)
        self.seen: list[Joint] = []
        self.start: Start | None = None

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Returns a prior that is not used: a recorder is never inferred."""
        return {"nothing": dist.Normal(0.0, 1.0)}

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> None:
        """Keeps what is known of the motion before."""
        self.start = start

    def begin_step(
        self, joint: Joint, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> Any:
        """Keeps the joint's state."""
        self.seen.append(joint)
        return memory


class _CommandPulse(ActionEffect):
    """A constant addition to a command during a part of each segment.

    Args:
        port: The command.
        begins: Time at which each segment begins, in s since its rollout began, ``(S,)``.
    """

    id = "learning_pulse"
    parameters = Pulse.parameters

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Returns priors that are not used: pulses are never inferred."""
        return {p.name: dist.Normal(0.0, port.rated) for p in self.parameters}

    def __init__(self, port: str, begins: Tensor) -> None:
        super().__init__(port)
        self.begins = begins

    def initial_memory(self, command: Tensor, start: Start) -> Tensor:
        """Returns the time since the segment's start, in the middle of a step.

        It is negative, because effects on commands begin with commands before the segment.
        """
        since = start.time.reshape(-1, len(self.begins)) - self.begins
        return since.reshape(start.time.shape) + 0.5 * start.time_step

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the command, with the height added during the pulse."""
        is_on = (memory >= parameters["begin"]) & (memory < parameters["end"])
        return commands.now() + parameters["height"] * is_on, memory + time_step


@dataclass(frozen=True)
class PortMotion:
    """What a law at one port may depend on, along S segments of K steps.

    Attributes:
        port: The port.
        values: Mean over each step of each variable, ``(S, K)``, by symbol: at a joint ``q``,
            ``v``, the drive's force ``tau``, and ``q_1``, ``v_1`` and so on of other joints; at
            an action its command ``u``; at a sensor its value ``y``; and the time ``t`` in s since
            the rollout began.
        units: Units of the variables.
        responses: Change of the whitened measurements per unit of the law, ``(S, N, P)``, in
            each of P parts of a segment; ``None`` at a sensor, where they depend on the law.
        edges: Steps at which the parts begin, and the last one ends, ``(P + 1,)``.
        time_step: Length of a step in s.
        past: What happened before each segment, oldest first, ``(S, M)``: at a joint its
            displacement in each of M intervals, at an action its command in each of M steps.
        interval: Length of these intervals in s.
        others: Ports of the other joints, in the order of their numbers.
    """

    port: Port
    values: dict[str, Tensor]
    units: dict[str, str]
    responses: Tensor | None
    edges: Tensor
    time_step: float
    past: Tensor
    interval: float
    others: tuple[str, ...] = ()

    def parts(self, values: Tensor) -> Tensor:
        """Returns the mean over each of the P parts, ``(S, P)``, of ``(S, K)``."""
        return self.columns(values[..., None])[..., 0]

    def columns(self, values: Tensor) -> Tensor:
        """Returns the mean over each of the P parts, ``(S, P, k)``.

        The product of :attr:`responses` with it is the change by a law.

        Args:
            values: The law's k columns at every step, ``(S, K, k)``.
        """
        sums = torch.cat((torch.zeros_like(values[:, :1]), values.cumsum(1)), dim=1)
        lengths = (self.edges[1:] - self.edges[:-1]).to(values)
        return (sums[:, self.edges[1:]] - sums[:, self.edges[:-1]]) / lengths[None, :, None]


def motion_at_ports(hypothesis: Hypothesis) -> list[PortMotion]:
    """Returns what laws may depend on at every joint, command and sensor.

    A port at which the engine does not tell the motion, or does not answer to a small pulse, is
    left out.

    Args:
        hypothesis: The fitted model.
    """
    fit = hypothesis.fit
    segments = hypothesis.segments.in_coarser_steps(fit.z, fit.offsets)
    inputs = segments.inputs
    steps = inputs.num_steps
    edges = torch.linspace(0, steps, min(LEARNING.num_parts, steps) + 1).round().long().unique()
    base = _run(segments, segments.simulator, fit.z, fit.offsets[None], {})
    found = []
    for port in segments.simulator.ports:
        if port.kind == "force":
            seen = _joint_motion(hypothesis, segments, port)
        elif port.kind in ("action", "servo"):
            seen = _command(segments, port)
        elif port.kind == "sensor":
            seen = _reading(hypothesis, segments, port)
        else:
            continue
        if seen is None:
            continue
        values, units, past, interval, others = seen
        end = edges, inputs.time_step, past, interval, others
        if port.kind == "sensor":
            found.append(PortMotion(port, values, units, None, *end))
            continue
        moved = _pulsed(hypothesis, segments, port, edges)
        if moved is None:
            continue
        change = segments.whitened(moved - base, fit.scale) / _height(port)
        if bool(change.isfinite().all()) and bool((change != 0.0).any()):
            found.append(PortMotion(port, values, units, change.permute(1, 2, 0), *end))
    return found


def _height(port: Port) -> float:
    return LEARNING.pulse_height * port.rated


def _run(
    segments: SegmentModel,
    simulator: Simulator,
    z: Tensor,
    offsets: Tensor,
    more: Mapping[str, Tensor],
) -> Tensor:
    parameters = {**segments.black_box(z[None]).parameters, **more}
    return segments.run(simulator, parameters, offsets)


def _pulsed(
    hypothesis: Hypothesis, segments: SegmentModel, port: Port, edges: Tensor
) -> Tensor | None:
    """Returns readings with a pulse in each part, ``(P, S, K, C)``; ``None`` if it cannot be."""
    fit, inputs = hypothesis.fit, segments.inputs
    pulse = Pulse(port.name)
    if port.kind != "force":
        pulse = _CommandPulse(port.name, inputs.start * inputs.time_step)
    seconds = edges.double() * inputs.time_step
    batch = {
        f"{pulse.name}.height": torch.full((len(edges) - 1,), _height(port), dtype=torch.float64),
        f"{pulse.name}.begin": seconds[:-1],
        f"{pulse.name}.end": seconds[1:],
    }
    starts = fit.offsets[None].expand(len(edges) - 1, -1, -1)
    try:
        simulator = segments.simulator.with_effects(pulse)
        return _run(segments, simulator, fit.z, starts, batch)
    except (NpdrError, NotImplementedError):
        return None


_Seen = tuple[dict[str, Tensor], dict[str, str], Tensor, float, tuple[str, ...]]
"""Variables, their units, what happened before, the length of its intervals, other joints."""


def _joint_motion(hypothesis: Hypothesis, segments: SegmentModel, port: Port) -> _Seen | None:
    """Returns position, velocity and drive at a joint; ``None`` if the engine does not tell."""
    recorder = _Recorder(port.name)
    fit, inputs = hypothesis.fit, segments.inputs
    try:
        simulator = segments.simulator.with_effects(recorder)
        _run(segments, simulator, fit.z, fit.offsets[None], {})
    except (NpdrError, NotImplementedError):
        return None
    steps, num = inputs.num_steps, inputs.num_segments
    if not recorder.seen or len(recorder.seen) % steps:
        return None

    def collected(of: Callable[[Joint], Tensor]) -> Tensor:
        every = torch.stack([torch.as_tensor(of(joint)).reshape(-1) for joint in recorder.seen])
        # (steps × substeps, S) → the mean over the substeps, (S, steps)
        return every.double().expand(-1, num).unflatten(0, (steps, -1)).mean(1).mT.contiguous()

    values = {"q": collected(lambda joint: joint.position)}
    values["v"] = collected(lambda joint: joint.velocity)
    units = {"q": port.coordinate, "v": f"{port.coordinate}/s"}
    if port.is_driven:
        values["tau"], units["tau"] = collected(lambda joint: joint.drive), port.unit
    values["t"], units["t"] = _time(segments), "s"
    others = tuple(recorder.seen[0].others)
    for number, name in enumerate(others, 1):
        unit = simulator.port(name).coordinate
        for symbol, part, own in (("q", 0, unit), ("v", 1, f"{unit}/s")):
            values[f"{symbol}_{number}"] = collected(partial(_of_other, name, part))
            units[f"{symbol}_{number}"] = own
    past, interval = torch.zeros(num, 0, dtype=torch.float64), inputs.time_step
    if recorder.start is not None and recorder.start.displacements:
        moved = [step.reshape(-1, num)[0] for step in recorder.start.displacements]
        past, interval = torch.stack(moved, dim=1).double(), recorder.start.interval
    return values, units, past, interval, others


def _of_other(name: str, part: int, joint: Joint) -> Tensor:
    return joint.others[name][part]


def _command(segments: SegmentModel, port: Port) -> _Seen | None:
    inputs = segments.inputs
    if port.name not in inputs.action_names:
        return None
    column = inputs.action_names.index(port.name)
    num_past = inputs.past_actions.shape[-2]
    every = inputs.commands(column, num_past=num_past, is_goal=port.kind == "servo").double()
    values = {"u": every[:, num_past:], "t": _time(segments)}
    return values, {"u": port.unit, "t": "s"}, every[:, :num_past], inputs.time_step, ()


def _reading(hypothesis: Hypothesis, segments: SegmentModel, port: Port) -> _Seen | None:
    """Returns the simulated value of a sensor; ``None`` if the recording does not have it.

    Measured values have their noise in common with the residuals.
    """
    if port.name not in segments.channel_names:
        return None
    column = segments.channel_names.index(port.name)
    value = (segments.observed - hypothesis.difference)[..., column].double()
    none = torch.zeros(len(value), 0, dtype=torch.float64)
    return {"y": value, "t": _time(segments)}, {"y": port.unit, "t": "s"}, none, 0.0, ()


def _time(segments: SegmentModel) -> Tensor:
    """Returns the time in the middle of each step, in s since the rollout began, ``(S, K)``."""
    inputs = segments.inputs
    steps = torch.arange(inputs.num_steps)
    return (inputs.start[:, None] + steps + 0.5).double() * inputs.time_step
