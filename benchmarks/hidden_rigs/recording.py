"""Recordings of a rig: excitation, true motion, readings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hidden_rigs.driving import commanded, references, starts
from hidden_rigs.hidden import Hidden
from hidden_rigs.measurement import Measurement, noisy
from hidden_rigs.mechanics import Array
from hidden_rigs.plant import Plant
from hidden_rigs.rig import Rig
from hidden_rigs.sensors import sensed
from hidden_rigs.transmissions import TRANSMISSIONS
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

__all__ = ["Recording", "record"]

# Seconds that a rig has been simulated when its recording begins, without commands: what a late
# sensor reports first has happened by then.
_LEAD = 0.2

# With that many times the rig's substeps, flanks of gears give way by a fortieth of the smallest
# play that shows, and the fastest shafts that show swing in twenty substeps.
_FINER_BEHIND_GEARS = 10

# Substeps in each hidden delay, lag or filter. A command that changes within a substep is averaged
# over it, which acts like a lag. A delay of half a substep then cannot be told from a lag; with
# five substeps in the delay, their difference is wrong by a hundredth.
_SUBSTEPS_IN_A_DELAY = 5

# Times the rig's substeps, at most, so that a recording takes seconds. In delays below a quarter
# of the rig's substep there are fewer than five.
_FINEST = 20

_TIMES = {
    "input_delay": "delay",
    "actuator_lag": "time_constant",
    "sensor_delay": "delay",
    "sensor_low_pass": "time_constant",
}
"""The parameter of each hidden effect that is a time and must last several substeps."""


@dataclass(frozen=True)
class Recording:
    """Rollouts with what nobody but the benchmark may see.

    Attributes:
        rollouts: Readings and commands.
        true_states: True positions, then velocities, at the samples, ``(R, K + 1, channels)``.
    """

    rollouts: Rollouts
    true_states: Array


def record(
    rig: Rig,
    excitations: Sequence[str],
    *,
    parameters: Mapping[str, float],
    hidden: Sequence[Hidden] = (),
    measurement: Measurement | None = None,
    is_from_rest: bool = False,
    seed: int,
    duration: float | None = None,
    substeps: int | None = None,
    played: tuple[Array, Array] | None = None,
) -> Recording:
    """Records one rollout per excitation, or plays commands in one.

    The noise, the excitations and the starts depend on the seed alone.

    Args:
        rig: The rig.
        excitations: Names of excitations, see :mod:`hidden_rigs.excitation`.
        parameters: True domain parameters.
        hidden: What is hidden.
        measurement: Noise; ``None`` for none at all.
        is_from_rest: Whether all rollouts start at rest in the pose zero; otherwise every second
            is let go from somewhere else.
        seed: The seed.
        duration: Seconds per rollout; ``None`` for the rig's.
        substeps: Integration steps per sample; ``None`` for the rig's, ten times those behind a
            gear or a shaft, and more in a short delay or lag.
        played: Commands, ``(K, actions)``, that are played in one rollout without the rig's
            feedback, and the positions, ``(joints,)``, in which it is held until then; ``None``
            for excitations.
    """
    num_substeps = substeps or _num_substeps(rig, hidden)
    substep = rig.time_step / num_substeps
    num_steps = (
        round((duration or rig.duration) / rig.time_step) if played is None else len(played[0])
    )
    lead = math.ceil(_LEAD / rig.time_step)
    skew = sum(h.parameters["skew"] for h in hidden if h.effect_id == "clock_skew")
    tail = math.ceil(num_steps * max(skew, 0.0)) + 1
    if played is None:
        wanted = references(rig, excitations, num_steps, tail, seed)
    else:
        after = np.repeat(played[0][-1:], tail, axis=0)
        wanted = np.concatenate((played[0], after))[..., None]
    num_rollouts = wanted.shape[-1]
    plant = Plant(
        rig.mechanics,
        rig.layout,
        parameters,
        hidden,
        num_rollouts=num_rollouts,
        substep=substep,
        duration=num_steps * rig.time_step,
        generator=np.random.default_rng(derived_seed(seed, "bursts")),
    )
    positions, velocities = starts(rig, num_rollouts, is_from_rest, seed)
    if played is not None:
        positions = played[1][:, None]
    q, v = plant.start(positions, velocities)
    num_joints = len(rig.layout.joints)
    motion = np.empty(((lead + num_steps + tail) * num_substeps + 1, 2 * num_joints, num_rollouts))
    motion[0] = np.concatenate((q[:num_joints], v[:num_joints]))
    commands = np.zeros((num_steps + tail, len(rig.limits), num_rollouts))
    row = 0
    for step in range(-lead, num_steps + tail):
        plant.begin_step(step * rig.time_step)
        if step >= 0:
            commands[step] = commanded(rig, wanted[step], q, v) if played is None else wanted[step]
        present = list(commands[step]) if step >= 0 else [np.zeros(num_rollouts)] * len(rig.limits)
        for k in range(num_substeps):
            if step < 0 and played is not None:
                row += 1
                motion[row] = motion[0]
                continue
            q, v = plant.advance(q, v, present, step * rig.time_step + k * substep)
            row += 1
            motion[row, :num_joints] = q[:num_joints]
            motion[row, num_joints:] = v[:num_joints]
    begin = lead * num_substeps
    values = sensed(motion, substep, begin, num_substeps, num_steps, hidden, rig.layout)
    if measurement is not None:
        noise = np.random.default_rng(derived_seed(seed, "noise"))
        values = noisy(values, measurement, noise)
    true = motion[begin : begin + num_steps * num_substeps + 1 : num_substeps]
    units = rig.units
    rollouts = Rollouts.from_arrays(
        values,
        commands[:num_steps].transpose(2, 0, 1),
        channel_names=rig.layout.sensors,
        action_names=rig.layout.actions,
        time_step=rig.time_step,
        channel_units=units[0],
        action_units=units[1],
    )
    return Recording(rollouts, true.transpose(2, 0, 1))


def _num_substeps(rig: Rig, hidden: Sequence[Hidden]) -> int:
    """Returns the integration steps per sample that the hidden effects need."""
    is_behind_gears = any(h.effect_id in TRANSMISSIONS for h in hidden)
    least = rig.substeps * (_FINER_BEHIND_GEARS if is_behind_gears else 1)
    times = [h.parameters[_TIMES[h.effect_id]] for h in hidden if h.effect_id in _TIMES]
    shortest = min((time for time in times if time > 0.0), default=math.inf)
    needed = math.ceil(_SUBSTEPS_IN_A_DELAY * rig.time_step / shortest)
    return min(max(least, needed), _FINEST * rig.substeps)
