"""Generic laws, without a physical meaning, that detect effects outside the catalogue.

* Forces at a joint: polynomials, signs and products of all recorded channels, waves in time, and
  ripples. A ripple is a wave in a position, alone or times a command or the direction of motion.
  The change from such a force is a weighted sum of the responses to pulses
  (:mod:`~npdr_ppl.discovery.screening.pulse_changes`).
* Errors of a sensor, as functions of its own value.
* Ringing after every change of speed, as of a part that is carried on a spring or stands on one.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Literal

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import ForceChange, PulseChanges
from npdr_ppl.discovery.screening.settings import GENERIC_LAWS
from npdr_ppl.language.channels import Channel

__all__ = [
    "PER_TURN",
    "GenericLaw",
    "generic_laws",
    "reading_laws",
    "ringing_laws",
    "ripple_laws",
    "strongest_frequency",
    "strongest_ripple",
    "wave_laws",
]


PER_TURN = range(GENERIC_LAWS.fewest_per_turn, GENERIC_LAWS.most_per_turn + 1)
"""Numbers of ripples per turn that are tried at the joint itself."""


@dataclass(frozen=True)
class GenericLaw:
    """A law outside the catalogue: a function of the recorded channels, as a force at a port.

    Attributes:
        name: Description, e.g. ``"arm: arm_velocity²"``.
        make: Returns the change. It is computed on demand, because the changes of hundreds of
            laws on a long recording do not fit into memory together.
        port: Port of the force.
        kind: ``"wave"`` or ``"ripple"`` if an effect of the catalogue at this port can be the same
            law. Its p-value then counts for that effect, too.
    """

    name: str
    make: Callable[[], Tensor | ForceChange]
    port: str = ""
    kind: Literal["", "wave", "ripple"] = ""

    @property
    def change(self) -> Tensor | ForceChange:
        """Its change of the whitened measurements; computed at each access.

        It is ``(S, N, k)``, or the values of a law of force at the pulses.
        """
        return self.make()


def generic_laws(
    found: Responses, ports: Mapping[str, PulseChanges], sensors: Sequence[Channel] = ()
) -> list[GenericLaw]:
    """Returns a dictionary of laws, as forces at every joint.

    Args:
        found: The responses to pulses.
        ports: The changes that forces can cause, by port.
        sensors: The simulator's sensors; of angles, sines and cosines are tried too.
    """
    values = _dictionary(found, {sensor.name for sensor in sensors if sensor.unit == "rad"})
    return [
        GenericLaw(f"{port}: {name}", partial(ForceChange, pulses, value[..., None]))
        for port, pulses in ports.items()
        for name, value in values.items()
    ]


def wave_laws(found: Responses, ports: Mapping[str, PulseChanges]) -> list[GenericLaw]:
    """Returns waves in time of many frequencies, as forces at every port.

    Args:
        found: The responses to pulses.
        ports: The changes that forces can cause, by port.
    """
    return [
        GenericLaw(
            f"{port}: wave of {frequency:.3g} Hz",
            partial(_waved, pulses, found, frequency),
            port,
            "wave",
        )
        for port, pulses in ports.items()
        for frequency in _frequencies(found).tolist()
    ]


def ripple_laws(
    found: Responses, ports: Mapping[str, PulseChanges], sensors: Sequence[Channel]
) -> list[GenericLaw]:
    """Returns ripples over every position, as forces at every port.

    Args:
        found: The responses to pulses.
        ports: The changes that forces can cause, by port.
        sensors: The simulator's sensors, which tell positions from velocities.
    """
    recorded = [sensor for sensor in sensors if sensor.name in found.channels]
    velocities = {sensor.rate_of: sensor.name for sensor in recorded if sensor.rate_of}
    commands = [name for name in found.channels if name not in {s.name for s in recorded}]
    laws = []
    for position in _positions(found, sensors):
        x = found.channels[position.name]
        factors = {"": torch.ones_like(x)}
        factors |= {f"{name} times ": found.channels[name] for name in commands}
        if position.name in velocities:
            direction = _sign(found.channels[velocities[position.name]])
            factors["direction times "] = direction
        for (port, pulses), (text, factor) in product(ports.items(), factors.items()):
            laws += [
                GenericLaw(
                    f"{port}: {text}ripple of {number:.3g} 1/{position.unit} in {position.name}",
                    partial(_rippled, pulses, factor, x, number),
                )
                for number in _numbers(x)
            ]
    turning = {s.name for s in _positions(found, sensors) if s.unit == "rad"}
    for port, name in found.positions.items():
        if name in turning:
            x, one = found.channels[name], torch.ones_like(found.time)
            laws += [
                GenericLaw(
                    f"{port}: {number} ripples per turn",
                    partial(_rippled, ports[port], one, x, number),
                    port,
                    "ripple",
                )
                for number in PER_TURN
            ]
    return laws


def _waved(pulses: PulseChanges, found: Responses, frequency: float) -> ForceChange:
    return ForceChange(pulses, _wave(found, frequency))


def _rippled(pulses: PulseChanges, factor: Tensor, x: Tensor, number: float) -> ForceChange:
    """Returns the change from a factor times a ripple over x, both ``(S, pulses)``."""
    return ForceChange(pulses, factor[..., None] * _ripple(x, number))


def _ripple(x: Tensor, number: float) -> Tensor:
    """Returns sine and cosine of a position at the pulses, ``(S, pulses, 2)``."""
    phase = number * (x - x.mean())
    return torch.stack((phase.sin(), phase.cos()), dim=-1)


def _positions(found: Responses, sensors: Sequence[Channel]) -> list[Channel]:
    """Returns the recorded positions that change."""
    return [
        s
        for s in sensors
        if s.name in found.channels
        and not s.rate_of
        and not s.unit.endswith("/s")
        and float(found.channels[s.name].max() - found.channels[s.name].min()) > 0.0
    ]


def _numbers(x: Tensor) -> list[float]:
    """Returns the wave numbers that are tried over a position."""
    step = math.pi / float(x.max() - x.min())
    return [j * step for j in range(1, GENERIC_LAWS.num_ripples + 1)]


def reading_laws(projection: Projection) -> list[GenericLaw]:
    """Returns errors of each sensor that depend on its own value.

    A segment begins at the measured state, so the error at its beginning is subtracted.

    Args:
        projection: The fitted model.
    """
    hypothesis, segments = projection.hypothesis, projection.hypothesis.segments
    # Of simulated values: measured ones have their noise in common with the residuals.
    simulated = segments.observed - hypothesis.difference
    laws = []
    for c, sensor in enumerate(segments.measured):
        x = simulated[..., c]
        for name, value in _of_one(sensor.name, x, sensor.unit == "rad").items():
            make = partial(_error_of, hypothesis, c, value - value[:, :1])
            laws.append(GenericLaw(f"{sensor.name}: error of {name}", make))
    return laws


def _error_of(hypothesis: Hypothesis, channel: int, error: Tensor) -> Tensor:
    """Returns the change of the whitened measurements, ``(S, N, 1)``, from a sensor's error.

    Args:
        hypothesis: The fitted model.
        channel: Column of the sensor.
        error: Its error, ``(S, K)``.
    """
    errors = torch.zeros_like(hypothesis.segments.observed, dtype=torch.float64)
    errors[..., channel] = error
    return hypothesis.segments.whitened(errors, hypothesis.fit.scale)[..., None]


def ringing_laws(projection: Projection) -> list[GenericLaw]:
    """Returns the ringing of a part after every change of speed.

    The part is a mass on a spring that the measured part carries, or that carries it. The phase
    of the oscillation is left open. A segment begins without oscillation.

    Args:
        projection: The fitted model.
    """
    hypothesis, segments = projection.hypothesis, projection.hypothesis.segments
    simulated = (segments.observed - hypothesis.difference).double()
    laws = []
    for name, position, rate in _motions(segments.measured):
        moving = simulated[..., position if rate is None else rate]
        if rate is None:
            moving = moving.diff(dim=1, prepend=moving[:, :1])
        kick = moving.diff(dim=1, prepend=moving[:, :1])
        for periods in torch.logspace(
            math.log10(GENERIC_LAWS.lowest_ringing_frequency),
            math.log10(0.5),
            GENERIC_LAWS.num_ringing_frequencies,
        ).tolist():
            make = partial(_rung, hypothesis, kick, position, rate, periods)
            frequency = periods / segments.inputs.time_step
            laws.append(GenericLaw(f"{name}: ringing at {frequency:.3g} Hz", make))
    return laws


def _rung(
    hypothesis: Hypothesis, kick: Tensor, position: int | None, rate: int | None, periods: float
) -> Tensor:
    """Returns the change of the whitened measurements, ``(S, N, 2)``, from ringing after kicks.

    Args:
        hypothesis: The fitted model.
        kick: Changes of speed, ``(S, K)``.
        position: Column of the position that rings, if it is measured.
        rate: Column of its velocity, if that is measured.
        periods: Periods per time step.
    """
    segments = hypothesis.segments
    steps = torch.arange(kick.shape[1])
    ages = (steps[:, None] - steps).clamp_min(0)
    angle = 2.0 * math.pi * periods
    decay = (
        complex(-GENERIC_LAWS.ringing_damping, math.sqrt(1.0 - GENERIC_LAWS.ringing_damping**2))
        * angle
    )
    after = torch.exp(decay * ages).tril()
    swing = kick.to(after.dtype) @ after.mT  # of the rate, (S, K)
    changed = torch.zeros((*segments.observed.shape, 2), dtype=torch.float64)
    if rate is not None:
        changed[..., rate, :] = torch.view_as_real(swing)
    if position is not None:
        h = 1.0 if rate is None else segments.inputs.time_step
        changed[..., position, :] = torch.view_as_real(swing * h / decay)
    scale = hypothesis.fit.scale
    return torch.stack([segments.whitened(c, scale) for c in changed.unbind(-1)], dim=-1)


def _motions(measured: Sequence[Channel]) -> list[tuple[str, int | None, int | None]]:
    """Returns the moving quantities: name, and the columns of position and velocity."""
    columns = {sensor.name: c for c, sensor in enumerate(measured)}
    positions = {s.rate_of: c for c, s in enumerate(measured) if s.rate_of}
    result: list[tuple[str, int | None, int | None]] = [
        (sensor.name, c, positions.get(sensor.name))
        for c, sensor in enumerate(measured)
        if not sensor.rate_of
    ]
    alone = (s for s in measured if s.rate_of and s.rate_of not in columns)
    return result + [(s.name, None, columns[s.name]) for s in alone]


def strongest_frequency(projection: Projection, found: Responses, port: str) -> float:
    """Returns the frequency in Hz of the wave in time that, as a force at a port, explains most.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        port: The port.
    """
    frequencies = _frequencies(found)
    waves = torch.cat([_wave(found, frequency) for frequency in frequencies.tolist()], dim=-1)
    return float(frequencies[_strongest(projection, found, port, waves)])


def strongest_ripple(projection: Projection, found: Responses, port: str) -> int | None:
    """Returns how many ripples per turn, as a force at a port, explain most.

    The result is ``None`` if no channel measures the position at the port, or it is constant.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        port: The port.
    """
    x = found.channels.get(found.positions.get(port, ""))
    if x is None or float(x.max() - x.min()) <= 0.0:
        return None
    waves = torch.cat([_ripple(x, number) for number in PER_TURN], dim=-1)
    return PER_TURN[_strongest(projection, found, port, waves)]


def _strongest(projection: Projection, found: Responses, port: str, waves: Tensor) -> int:
    """Returns the index of the wave that, as a force at a port, explains most.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        port: The port.
        waves: Sine and cosine of each wave at the pulses, ``(S, pulses, 2 n)``.
    """
    scores = PulseChanges(projection, found.by_port[port]).scores(waves)
    gains = [scores.gain(slice(k, k + 2)) for k in range(0, waves.shape[-1], 2)]
    return max(range(len(gains)), key=gains.__getitem__)


def _frequencies(found: Responses) -> Tensor:
    step = 0.5 / float(found.time.max() - found.time.min())
    return step * torch.arange(1, GENERIC_LAWS.num_frequencies + 1, dtype=torch.float64)


def _wave(found: Responses, frequency: float) -> Tensor:
    """Returns sine and cosine at the pulses, ``(S, pulses, 2)``."""
    angle = 2.0 * torch.pi * frequency * found.time
    return torch.stack((angle.sin(), angle.cos()), dim=-1)


def _sign(x: Tensor) -> Tensor:
    """Returns the sign of a channel, smoothed over :data:`GENERIC_LAWS.sign_width`."""
    return torch.tanh(x / x.square().mean().sqrt().clamp_min(1e-12) / GENERIC_LAWS.sign_width)


def _dictionary(found: Responses, angles: set[str]) -> dict[str, Tensor]:
    """Returns the laws' values at the pulses, scaled to unit spread."""
    channels, time = found.channels, found.time
    values: dict[str, Tensor] = {"1": torch.ones_like(time), "t": time}
    signs = {name: _sign(x) for name, x in channels.items()}
    for name, x in channels.items():
        values |= _of_one(name, x, name in angles)
        values[f"sign {name}"] = signs[name]
        values[f"t·{name}"] = time * values[name]
    names = list(channels)
    unit = {name: values[name] for name in names}
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            values[f"{one}·{other}"] = unit[one] * unit[other]
            values[f"{one}²·{other}"] = unit[one].square() * unit[other]
            values[f"{one}·{other}²"] = unit[one] * unit[other].square()
            values[f"|{one}|·sign {other}"] = unit[one].abs() * signs[other]
            values[f"|{other}|·sign {one}"] = unit[other].abs() * signs[one]
    return {k: v / v.square().mean().sqrt().clamp_min(1e-12) for k, v in values.items()}


def _of_one(name: str, channel: Tensor, is_angle: bool) -> dict[str, Tensor]:
    """Returns functions of one channel, by name."""
    x = channel / channel.square().mean().sqrt().clamp_min(1e-12)
    values = {
        name: x,
        f"{name}²": x.square(),
        f"{name}³": x**3,
        f"{name}|{name}|": x * x.abs(),
        f"|{name}|": x.abs(),
    }
    if is_angle:
        for order in (1, 2, 3):
            values[f"sin {order} {name}"] = torch.sin(order * channel)
            values[f"cos {order} {name}"] = torch.cos(order * channel)
    return values
