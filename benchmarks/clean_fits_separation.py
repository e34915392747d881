"""How far a recording is from all that a rig without hidden effects can do.

Parameters and starts are fitted to noise-free readings by the benchmark's own equations, in
segments. What is left, in standard deviations of the readings' noise, is the separation d: no
method that knows the equations can explain the recording better.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from hidden_rigs.mechanics import Array, Surroundings, accelerations
from hidden_rigs.recording import Recording
from hidden_rigs.rig import Rig
from scipy.optimize import lsq_linear

__all__ = ["replayed", "separation"]

SEGMENT = 0.5
"""Seconds of a segment: starts far apart show slow effects, near ones keep the fit linear."""

ITERATIONS = 6
"""Gauss-Newton steps at most; a fit that begins at the truth takes three."""

SHARES = (1.0, 0.5, 0.2, 0.05)
"""Shares of a Gauss-Newton step that are tried."""

CONVERGED = 0.01
"""Relative decrease of the misfit below which the fit ends."""

RELATIVE_STEP = 1e-4
"""Step of a finite difference, in the prior's width, and of starts in ten deviations of noise."""

RIDGE = 1e-6
"""Weight on a step in units of the prior's width: it only settles what nothing determines."""


def replayed(
    rig: Rig, parameters: Mapping[str, float], starts: Array, commands: Array, substeps: int
) -> Array:
    """Integrates a rig under recorded commands by the classical Runge-Kutta method.

    Args:
        rig: The rig; nothing is hidden in it.
        parameters: True values of all parameters.
        starts: Positions, then velocities, ``(2 joints, S)``.
        commands: Commands, each held for one sample, ``(K, actions, S)``.
        substeps: Integration steps per sample.

    Returns:
        The state after each sample, ``(K, 2 joints, S)``.
    """
    mechanics = rig.mechanics(parameters, Surroundings())
    num_joints, step = len(starts) // 2, rig.time_step / substeps

    def rates(state: Array, drives: Sequence[Array]) -> Array:
        q, v = state[:num_joints], state[num_joints:]
        forces = [f + d for f, d in zip(mechanics.forces(q, v), drives, strict=True)]
        return np.concatenate(
            (v, accelerations(mechanics.inertia(q), forces, [None] * num_joints))
        )

    state, result = starts, np.empty((len(commands), *starts.shape))
    for k, command in enumerate(commands):
        drives = mechanics.drives(list(command))
        for _ in range(substeps):
            k1 = rates(state, drives)
            k2 = rates(state + 0.5 * step * k1, drives)
            k3 = rates(state + 0.5 * step * k2, drives)
            k4 = rates(state + step * k3, drives)
            state = state + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        result[k] = state
    return result


def separation(
    rig: Rig,
    recording: Recording,
    parameters: Mapping[str, float],
    prior: Mapping[str, tuple[float, float]],
    rollouts: Sequence[int],
) -> float:
    """Returns the separation d of a noise-free recording from the rig without hidden effects.

    Args:
        rig: The rig.
        recording: The recording, without noise.
        parameters: Parameters at which the fit begins.
        prior: Ends within which each parameter is fitted; the rig's known ones stay.
        rollouts: The rollouts to fit.
    """
    problem = _Problem.of(rig, recording, prior, rollouts)
    point = np.array([np.clip(parameters[name], *prior[name]) for name in prior])
    starts = problem.starts
    least = problem.misfit(point, starts)
    for _ in range(ITERATIONS):
        change, shift = problem.step(point, starts)
        tried = [(point + share * change, starts + share * shift) for share in SHARES]
        misfits = [problem.misfit(*place) for place in tried]
        best = int(np.argmin(misfits))
        if not misfits[best] < least:
            break
        is_done = misfits[best] > (1.0 - CONVERGED) * least
        least, (point, starts) = misfits[best], tried[best]
        if is_done:
            break
    return float(np.sqrt(least))


@dataclass(frozen=True)
class _Problem:
    """Least squares over parameters, (P,), and starts, (2 joints, S).

    Attributes:
        rig: The rig.
        names: Names of the parameters.
        ends: Ends of each parameter, (P, 2).
        starts: True states at the start of each segment.
        commands: (K, actions, S).
        readings: (K, 2 joints, S).
        noise: Standard deviation of each reading, (2 joints, 1).
    """

    rig: Rig
    names: tuple[str, ...]
    ends: Array
    starts: Array
    commands: Array
    readings: Array
    noise: Array

    @classmethod
    def of(
        cls,
        rig: Rig,
        recording: Recording,
        prior: Mapping[str, tuple[float, float]],
        rollouts: Sequence[int],
    ) -> "_Problem":
        """Cuts a recording into segments."""
        length = round(SEGMENT / rig.time_step)
        starts, commands, readings = [], [], []
        for r in rollouts:
            actions = recording.rollouts.actions[r]
            for first in range(0, len(actions) - length + 1, length):
                starts.append(recording.true_states[r, first])
                commands.append(actions[first : first + length])
                readings.append(recording.rollouts.readings[r][first + 1 : first + length + 1])
        measurement = rig.measurement
        counts = np.array(measurement.counts) / np.sqrt(12.0)
        return cls(
            rig,
            tuple(prior),
            np.array([prior[name] for name in prior]),
            np.array(starts).T,
            np.stack(commands, axis=-1),
            np.stack(readings, axis=-1),
            np.concatenate((counts, measurement.velocity_noise))[:, None],
        )

    def residual(self, point: Array, starts: Array) -> Array:
        """Returns the residuals in units of the noise, ``(K, 2 joints, S · repetitions)``."""
        parameters = {**self.rig.known, **dict(zip(self.names, point.tolist(), strict=True))}
        times = starts.shape[1] // self.readings.shape[-1]
        with np.errstate(over="ignore", invalid="ignore"):
            found = replayed(
                self.rig,
                parameters,
                starts,
                np.tile(self.commands, times),
                self.rig.substeps,
            )
            return (np.tile(self.readings, times) - found) / self.noise

    def misfit(self, point: Array, starts: Array) -> float:
        """Returns the sum of squares; infinity where the motion is."""
        total = float(np.square(self.residual(point, starts)).sum())
        return total if np.isfinite(total) else np.inf

    def step(self, point: Array, starts: Array) -> tuple[Array, Array]:
        """Returns the Gauss-Newton step of the parameters within their ends, and of the starts."""
        num_states, num_segments = starts.shape
        moves = 10.0 * RELATIVE_STEP * self.noise[:, 0]
        shifted = [starts] + [
            starts + move * (np.arange(num_states) == i)[:, None] for i, move in enumerate(moves)
        ]
        every = self.residual(point, np.concatenate(shifted, axis=1))
        base, *others = np.split(every.reshape(-1, every.shape[-1]), len(shifted), axis=1)
        # (S, m, 2 joints), (S, m)
        by_start = np.stack(
            [((o - base) / move).T for o, move in zip(others, moves, strict=True)], -1
        )
        left = base.T
        width = self.ends[:, 1] - self.ends[:, 0]
        columns = []
        for i, size in enumerate(width):
            move = RELATIVE_STEP * size * (1.0 if point[i] < self.ends[i].mean() else -1.0)
            changed = self.residual(point + move * (np.arange(len(point)) == i), starts)
            columns.append(((changed.reshape(base.shape) - base) * (size / move)).T)
        by_parameter = np.stack(columns, -1)  # (S, m, P), per width of the prior
        basis = np.linalg.qr(by_start)[0]

        def without_starts(values: Array) -> Array:
            return values - basis @ (basis.swapaxes(1, 2) @ values)

        matrix = without_starts(by_parameter).reshape(-1, len(point))
        target = -without_starts(left[..., None]).ravel()
        matrix = np.vstack((matrix, RIDGE * np.linalg.norm(matrix) * np.eye(len(point))))
        target = np.concatenate((target, np.zeros(len(point))))
        # An end on which the point lies already must not come out a rounding error beyond it.
        bounds = (self.ends - point[:, None]) / width[:, None] + np.array([-1e-12, 1e-12])
        change = lsq_linear(matrix, target, bounds=(bounds[:, 0], bounds[:, 1])).x
        remaining = left + by_parameter @ change
        shift = [-np.linalg.lstsq(by_start[s], remaining[s])[0] for s in range(num_segments)]
        point_change = np.clip(point + change * width, *self.ends.T) - point
        return point_change, np.array(shift).T
