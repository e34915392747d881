"""The force that the model lacks, estimated without a law.

A small pulse of force at a joint during a part of every segment changes the measurements linearly.
The change from *any* force law is then a weighted sum of the responses to all pulses: the weights
are the law's values at the pulses, and no other simulation is needed. So many laws can be tried
(:mod:`~npdr_ppl.discovery.screening.generic_laws`), and the missing force itself can be estimated
and shown against the states.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import LATENT_FORCE
from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.models.effects.timed import TimedForceEffect
from npdr_ppl.preparation.segment_model import SegmentModel

__all__ = ["LatentForce", "Responses", "latent_force", "responses"]


class Pulse(TimedForceEffect):
    """A constant force during a part of each segment."""

    id = "pulse"
    acts_on_floating = True
    start_positions: Tensor | None = None
    """The joint's positions at the starts of the segments, once they were simulated."""
    parameters = (
        Parameter("height", "{port}", 0.0, "force during the pulse"),
        Parameter("begin", "s", 0.0, "when it begins, from the segment's start"),
        Parameter("end", "s", 0.0, "when it ends"),
    )

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Returns priors that are not used: pulses are never inferred."""
        one = dist.Normal(0.0, port.rated)
        return {"height": one, "begin": dist.HalfNormal(1.0), "end": dist.HalfNormal(1.0)}

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> Tensor:
        """Returns the time since the segment's start, in the middle of the first step."""
        self.start_positions = position.detach()
        return torch.full_like(start.time, 0.5 * start.time_step)

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns the height during the pulse."""
        is_on = (memory >= parameters["begin"]) & (memory < parameters["end"])
        return parameters["height"] * is_on


@dataclass(frozen=True)
class Responses:
    """The responses to pulses of force.

    Attributes:
        by_port: Change of the whitened measurements per unit force, ``(S, N, pulses)``, by port.
        units: Unit of each port's force.
        rated: Each port's rated force.
        positions: Name of the channel that measures the position at each port, if there is one.
        channels: Simulated measurements, by channel, and commands, by action, at the beginning of
            each pulse, ``(S, pulses)``.
        time: Beginning of each pulse in seconds since the rollout began, ``(S, pulses)``.
        is_recorded: Which pulses begin within a segment, ``(S, pulses)``; shorter segments are
            padded.
        rollout: Index of each segment's rollout, ``(S,)``.
    """

    by_port: dict[str, Tensor]
    units: dict[str, str]
    rated: dict[str, float]
    positions: dict[str, str]
    channels: dict[str, Tensor]
    time: Tensor
    is_recorded: Tensor
    rollout: Tensor


@dataclass(frozen=True)
class LatentForce:
    """The missing force at a joint, estimated without a law.

    Attributes:
        port: The joint.
        unit: Unit of the force.
        force: Estimate per pulse, ``(S, pulses)``.
        error: Its standard deviation, ``(S, pulses)``.
    """

    port: str
    unit: str
    force: Tensor
    error: Tensor


def responses(hypothesis: Hypothesis) -> Responses:
    """Returns the responses to pulses at every joint.

    Args:
        hypothesis: The fitted model.
    """
    fit = hypothesis.fit
    segments = hypothesis.segments.in_coarser_steps(fit.z, fit.offsets)
    inputs, simulator = segments.inputs, segments.simulator
    steps = inputs.num_steps
    edges = (
        torch.linspace(0, steps, min(LATENT_FORCE.num_pulses, steps) + 1).round().long().unique()
    )
    seconds = edges.double() * inputs.time_step
    box = segments.black_box(fit.z[None])
    base = segments.run(simulator, box.parameters, fit.offsets[None])[0]
    by_port, units, rated, positions = {}, {}, {}, {}
    for port in simulator.ports:
        if port.kind != "force":
            continue
        pulse = Pulse(port.name)
        height = LATENT_FORCE.pulse_height * port.rated
        batch = {
            f"{pulse.name}.height": torch.full((len(edges) - 1,), height, dtype=torch.float64),
            f"{pulse.name}.begin": seconds[:-1],
            f"{pulse.name}.end": seconds[1:],
        }
        starts = fit.offsets[None].expand(len(edges) - 1, -1, -1)
        moved = segments.run(simulator.with_effects(pulse), {**box.parameters, **batch}, starts)
        change = segments.whitened(moved - base, fit.scale) / height
        if bool(change.isfinite().all()):
            by_port[port.name] = change.permute(1, 2, 0)
            units[port.name], rated[port.name] = port.unit, port.rated
            is_known = pulse.start_positions is not None
            measured = _measuring(pulse, port, segments) if is_known else None
            if measured is not None:
                positions[port.name] = measured
    begins = edges[:-1]
    channels = {
        name: base[:, begins.clamp_min(1) - 1, k].double()
        for k, name in enumerate(segments.channel_names)
    }
    for k, name in enumerate(inputs.action_names):
        channels[name] = inputs.actions[:, begins, k].double()
    time = (inputs.start[:, None] + begins) * inputs.time_step
    is_recorded = inputs.mask[:, begins]
    return Responses(
        by_port, units, rated, positions, channels, time.double(), is_recorded, inputs.rollout
    )


def _measuring(pulse: Pulse, port: Port, segments: SegmentModel) -> str | None:
    """Returns the channel that measures the position at a port; ``None`` if there is none.

    Of the channels in the port's unit, it is the one whose values at the starts of the segments
    differ from the joint's positions only by a constant, up to errors that are small beside the
    motion.

    Args:
        pulse: A pulse at the port, which was simulated.
        port: The port.
        segments: The model along the recording.
    """
    assert pulse.start_positions is not None
    inputs = segments.inputs
    position = pulse.start_positions.double().reshape(-1, inputs.num_segments)[0]
    names = inputs.channel_names
    found: dict[str, float] = {}
    for sensor in segments.measured:
        if sensor.unit == port.coordinate and not sensor.rate_of:
            values = inputs.initial_values[..., names.index(sensor.name)].double()
            values = values.reshape(-1, inputs.num_segments)[0]
            found[sensor.name] = float((values - position).std() / position.std())
    best = min(found, key=found.__getitem__, default=None)
    return best if best is not None and found[best] < LATENT_FORCE.largest_difference else None


def latent_force(projection: Projection, found: Responses) -> list[LatentForce]:
    """Estimates the missing force at every joint, with the initial states integrated out.

    Each pulse's force has a normal prior with mean zero. The prior's standard deviation is the one
    under which the recording is likeliest (empirical Bayes). A joint has one for all segments.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
    """
    result = []
    for port, change in found.by_port.items():
        weighted = projection.solve(change)
        gram = change.mT @ weighted
        score = (weighted.mT @ projection.residual[..., None])[..., 0]
        values, vectors = torch.linalg.eigh(gram)
        rotated = (vectors.mT @ score[..., None])[..., 0]
        spreads = found.rated[port] * torch.logspace(-4, 1, 26, dtype=torch.float64)
        growth = 1.0 + values.clamp_min(0.0)[None] * spreads[:, None, None] ** 2
        gain = spreads[:, None, None] ** 2 * rotated.square() / growth - growth.log()
        spread = spreads[gain.sum((1, 2)).argmax()]
        precision = gram + torch.eye(gram.shape[-1], dtype=torch.float64) / spread**2
        covariance = torch.linalg.inv(precision)
        force = (covariance @ score[..., None])[..., 0]
        error = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
        result.append(LatentForce(port, found.units[port], force, error))
    return result
