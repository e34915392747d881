"""The force that a fitted model lacks along a recording, by inverse dynamics.

Positions are smoothed and differentiated, every sample is simulated for one step from there, and
what the velocity does beyond is divided by what a force at each joint would have done. Both that
force and anything it is to be explained with then pass one low-pass filter and are thinned to
twice its cut-off: the practice of robot identification, see
:mod:`npdr_ppl.rollouts.differentiation`. Errors of what was differentiated twice alternate, so
that neighbouring rows are correlated by about −0.6; laws that are smooth in time do not feel it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.effects import Bias
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.differentiation import Smoothing, cutoffs, differentiate, thin

__all__ = ["Motion", "ResidualForces", "residual_forces"]

Array = NDArray[np.float64]

PROBE = 1e-2
"""Height of the force that shows what a force does, in the port's rated one."""


@dataclass(frozen=True)
class Motion:
    """What a law can be a function of, in the middle of each of T steps.

    Attributes:
        positions: Smoothed positions, ``(T, J)``, in the joints' coordinates.
        velocities: Smoothed velocities, ``(T, J)``, in coordinates per second.
        actions: Commands, ``(T, A)``.
        action_rates: Changes of the commands per second, ``(T, A)``.
    """

    positions: Array
    velocities: Array
    actions: Array
    action_rates: Array


@dataclass(frozen=True)
class ResidualForces:
    """The missing force at every joint, rollout by rollout.

    Attributes:
        ports: The J joints.
        forces: Before the parallel filter, ``(T, J)`` per rollout, in the ports' units.
        motions: The motion likewise.
        time_step: Seconds between rows.
        cutoff: Cut-off of the parallel filter, in Hz.
    """

    ports: tuple[Port, ...]
    forces: list[Array]
    motions: list[Motion]
    time_step: float
    cutoff: float

    def filtered(self, columns: list[Array]) -> Array:
        """Passes columns, ``(T, k)`` per rollout, through the parallel filter, ``(n, k)``."""
        return np.concatenate([thin(c, self.time_step, self.cutoff) for c in columns])


def residual_forces(
    hypothesis: Hypothesis, rollouts: Rollouts, smoothing: Smoothing | None = None
) -> ResidualForces:
    """Returns the force that a fitted model lacks.

    Args:
        hypothesis: The model, its parameters fitted.
        rollouts: The recording.
        smoothing: Cut-offs; automatic ones if left out.

    Raises:
        DataError: The positions of all joints are not on record, or too short.
    """
    simulator = hypothesis.simulator
    ports = tuple(port for port in simulator.ports if port.kind == "force")
    # A simulator lists its joints, and their positions, in the same order.
    rate_of = {s.rate_of: s.name for s in simulator.states if s.rate_of is not None}
    names = tuple(s.name for s in simulator.states if s.name in rate_of)
    if len(names) != len(ports) or not set(names) <= set(rollouts.channel_names):
        raise DataError(
            f"Needs a position on record for each of {', '.join(p.name for p in ports)}; got "
            f"{', '.join(rollouts.channel_names)}."
        )
    columns = [rollouts.channel_names.index(name) for name in names]
    readings = [values[:, columns] for values in rollouts.readings]
    low_pass, parallel = cutoffs(readings, rollouts.time_step, smoothing or Smoothing())
    channels = (*names, *(rate_of[name] for name in names))
    forces, motions = [], []
    for positions, actions in zip(readings, rollouts.actions, strict=True):
        smooth = differentiate(positions, rollouts.time_step, low_pass)
        inputs = _one_step_each(
            np.concatenate((smooth.positions, smooth.velocities), axis=1)[:-1],
            channels,
            actions,
            rollouts,
        )
        forces.append(
            _missing(hypothesis, ports, channels[len(names) :], inputs, smooth.velocities)
        )
        motions.append(
            Motion(
                _middle(smooth.positions),
                _middle(smooth.velocities),
                actions,
                np.diff(actions, axis=0, prepend=actions[:1]) / rollouts.time_step,
            )
        )
    return ResidualForces(ports, forces, motions, rollouts.time_step, parallel)


def _one_step_each(
    states: Array, channels: tuple[str, ...], actions: Array, rollouts: Rollouts
) -> Inputs:
    """Returns a segment of one step for every sample."""
    start = torch.from_numpy(states)
    num = len(states)
    return Inputs(
        actions=torch.from_numpy(np.array(actions))[:, None],
        action_names=rollouts.action_names,
        initial_readings=start,
        initial_values=start,
        channel_names=channels,
        past_actions=torch.zeros(num, 0, len(rollouts.action_names), dtype=torch.float64),
        time_step=rollouts.time_step,
        mask=torch.ones(num, 1, dtype=torch.bool),
        rollout=torch.zeros(num, dtype=torch.long),
        start=torch.arange(num),
    )


def _missing(
    hypothesis: Hypothesis,
    ports: tuple[Port, ...],
    rates: tuple[str, ...],
    inputs: Inputs,
    velocities: Array,
) -> Array:
    """Returns the forces that would move the simulated velocities to the smoothed ones."""
    box = hypothesis.segments.black_box(hypothesis.fit.z[None])
    after = _velocities(box.simulator, box.parameters, rates, inputs)
    answers = []
    for port in ports:
        probe = Bias(port.name)
        height = PROBE * port.rated
        given = {**box.parameters, f"{probe.name}.offset": torch.tensor([height]).double()}
        moved = _velocities(box.simulator.with_effects(probe), given, rates, inputs)
        answers.append((moved - after) / height)
    # Rows of J velocities by J forces.
    response = np.stack(answers, axis=-1)
    left = velocities[1:] - after
    return np.linalg.solve(response, left[..., None])[..., 0]


def _velocities(
    simulator: Simulator,
    parameters: Mapping[str, torch.Tensor],
    rates: tuple[str, ...],
    inputs: Inputs,
) -> Array:
    """Returns the velocities after one step, ``(T, J)``."""
    sensors = [sensor.name for sensor in simulator.sensors]
    readings = simulator.simulate(parameters, inputs)[0, :, 0]
    return readings[:, [sensors.index(name) for name in rates]].double().numpy()


def _middle(values: Array) -> Array:
    return 0.5 * (values[1:] + values[:-1])
