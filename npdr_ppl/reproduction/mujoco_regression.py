"""Bayesian linear regression of any MJCF's inertial and friction parameters.

No motion determines all ten inertial parameters of every body, because the regressor's columns
are linearly dependent. A rank-revealing QR with column pivoting finds the base parameters β = K π
that a recording determines (Gautier 1991). The conjugate posterior is over β. Each draw is mapped
to the physical parameters π with the smallest change from the nominal ones. Physically impossible
draws are counted.

Reference: M. Gautier, Numerical calculation of the base inertial parameters of robots, 1991.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg

from npdr_ppl.engines.mujoco.base_parameters import (
    MujocoInverseDynamics,
    actuator_forces,
    is_physical,
    load_mjcf,
)
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.inference.parts.samplers.conjugate import StudentT, linear_posterior, row_noise
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts.differentiation import (
    Smoothing,
    cutoffs,
    differentiate,
    held_actions,
    thin,
)

__all__ = ["MjcfPosterior", "regress_mjcf", "regress_mjcf_recording"]

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

RELATIVE_RANK = 1e-8
"""Smallest diagonal entry of R that is used, relative to the largest. Directions that no motion
determines are below 1e-13; directions below this limit are lost in any noise."""


@dataclass(frozen=True)
class MjcfPosterior:
    """Posterior over the parameters of an MJCF.

    Attributes:
        dynamics: The model's inverse dynamics.
        names: Names of its parameters π, P of them.
        base_names: Main parameter of each base parameter β, r of them; the others in its row of
            ``grouping`` are combined with it.
        grouping: K with β = K π, ``(r, P)``.
        base: Posterior over β.
        nominal: π of the given model, ``(P,)``.
        scales: Unit in which the change of each π is measured, ``(P,)``; zero for fixed ones.
    """

    dynamics: MujocoInverseDynamics
    names: tuple[str, ...]
    base_names: tuple[str, ...]
    grouping: Array
    base: StudentT
    nominal: Array
    scales: Array

    def to_physical(self, base: Array) -> Array:
        """Returns the π with these β and the smallest change from the nominal ones.

        The change is measured by ‖(π − π₀)/s‖ with the scales s.

        Args:
            base: Base parameters, ``(n, r)``.

        Returns:
            Parameters, ``(n, P)``; some may be physically impossible.
        """
        inverse = self.scales[:, None] * np.linalg.pinv(self.grouping * self.scales)
        return self.nominal + (base - self.grouping @ self.nominal) @ inverse.T

    def mean(self) -> dict[str, float]:
        """Returns π at the mean of β, by name."""
        values = self.to_physical(self.base.mean.numpy()[None])[0]
        return dict(zip(self.names, values.tolist(), strict=True))

    def draw(self, num_draws: int, *, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
        """Draws from the posterior, including impossible draws, which are counted and logged.

        Args:
            num_draws: Number of draws n.
            seed: Seed of the draws.

        Returns:
            Parameters ``(n, P)`` and the mask ``(n,)`` of those that are physical; see
            :func:`~npdr_ppl.engines.mujoco.base_parameters.is_physical`.
        """
        with seeded(seed, "mjcf posterior"):
            base = self.base.sample(num_draws).numpy()
        parameters = self.to_physical(base)
        possible = is_physical(parameters, len(self.dynamics.bodies))
        implausible = num_draws - int(possible.sum())
        if implausible:
            logger.warning(
                "%d of %d draws (%.1f %%) of the regression's posterior are implausible.",
                implausible,
                num_draws,
                100.0 * implausible / num_draws,
            )
        return parameters, possible


def regress_mjcf(
    source: Any,
    positions: Array,
    velocities: Array,
    accelerations: Array,
    applied: Array,
    *,
    fixed: Sequence[str] = (),
    prior_spread: float = 10.0,
) -> MjcfPosterior:
    """Regresses an MJCF's parameters on a known motion at N instants.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel``; its parameters are nominal.
        positions: MuJoCo's qpos, ``(N, nq)``.
        velocities: Its qvel, ``(N, nv)``.
        accelerations: Its qacc, ``(N, nv)``.
        applied: Applied generalised forces including those of actuators, ``(N, nv)``.
        fixed: Name patterns of parameters that are known to be nominal, e.g. ``"*.armature"``.
            Fix the damping of a joint without damping: noise would make half of its estimates
            negative, hence implausible.
        prior_spread: Standard deviation of the prior about the nominal values, in scales of the
            parameters, if the noise equals the residuals of the fit.

    Raises:
        ModelError: The model has no joints, or equality constraints, or no such parameter.
        ShapeError: The shapes do not fit the model.
        DataError: Nothing moves, or all parameters are fixed.
    """
    dynamics = MujocoInverseDynamics(load_mjcf(source))
    rows = dynamics.regressors(positions, velocities, accelerations)
    targets = dynamics.targets(positions, velocities, applied)
    return _regress(dynamics, rows, targets, fixed, prior_spread)


def regress_mjcf_recording(
    source: Any,
    positions: Array,
    controls: Array,
    time_step: float,
    *,
    smoothing: Smoothing | None = None,
    fixed: Sequence[str] = (),
    prior_spread: float = 10.0,
) -> MjcfPosterior:
    """Regresses an MJCF's parameters on one recording of joint positions and controls.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel`` of hinges and slides only.
        positions: Position measurements, ``(T + 1, nq)``.
        controls: Controls, each held for one step, ``(T, nu)``.
        time_step: Seconds between measurements.
        smoothing: Cut-offs of the filters.
        fixed: See :func:`regress_mjcf`.
        prior_spread: See :func:`regress_mjcf`.

    Raises:
        ModelError: The model has other joints, equality constraints, or actuators with states.
        ShapeError: The shapes do not fit the model.
        DataError: The recording is too short, or nothing moves.
    """
    model = load_mjcf(source)
    if model.nq != model.nv:
        raise ModelError(
            "Only positions of hinges and slides can be differentiated; for balls and free "
            "joints give velocities and accelerations to regress_mjcf."
        )
    dynamics = MujocoInverseDynamics(model)
    position_cutoff, parallel_cutoff = cutoffs([positions], time_step, smoothing or Smoothing())
    motion = differentiate(positions, time_step, position_cutoff)
    forces = actuator_forces(model, motion.positions, motion.velocities, held_actions(controls))
    rows = dynamics.regressors(motion.positions, motion.velocities, motion.accelerations)
    targets = dynamics.targets(motion.positions, motion.velocities, forces)
    both = np.concatenate((rows, targets[..., None]), axis=-1)
    both = thin(both, time_step, parallel_cutoff)
    return _regress(dynamics, both[..., :-1], both[..., -1], fixed, prior_spread)


def _regress(
    dynamics: MujocoInverseDynamics,
    rows: Array,
    targets: Array,
    fixed: Sequence[str],
    prior_spread: float,
) -> MjcfPosterior:
    nominal, names = dynamics.nominal(), dynamics.names
    is_fixed = _matches(names, fixed)
    targets = targets - rows[..., is_fixed] @ nominal[is_fixed]
    # Fixed parameters have scale zero.
    scales = np.where(is_fixed, 0.0, _scales(dynamics, nominal))
    chosen, grouping = _base(rows, scales)
    mean = torch.as_tensor(grouping @ nominal)
    spread = torch.as_tensor(prior_spread * grouping * scales)
    covariance = spread @ spread.T
    regressors, right = torch.as_tensor(rows[..., chosen]), torch.as_tensor(targets)
    noise = row_noise(regressors, right, mean, covariance)
    posterior = linear_posterior(
        (regressors / noise[:, None]).flatten(0, 1), (right / noise).flatten(), mean, covariance
    )
    base_names = tuple(names[i] for i in chosen)
    return MjcfPosterior(dynamics, names, base_names, grouping, posterior, nominal, scales)


def _matches(names: Sequence[str], patterns: Sequence[str]) -> NDArray[np.bool_]:
    """Returns a mask ``(P,)`` of the names that match a pattern."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ModelError(f"No parameter is called {pattern!r}; there are {', '.join(names)}.")
    return np.array([any(fnmatchcase(name, pattern) for pattern in patterns) for name in names])


def _base(rows: Array, scales: Array) -> tuple[NDArray[np.int64], Array]:
    """Returns the independent columns, ``(r,)``, and K, ``(r, P)``.

    With W S P = Q [R₁ R₂; 0 0], the columns after the first r are W_d = W_b R₁⁻¹ R₂ in scaled
    units, so their parameters are combined with those of the first r: β = π_b + R₁⁻¹ R₂ π_d.
    """
    matrix = (rows * scales).reshape(-1, rows.shape[-1])
    decomposition: Any = linalg.qr(matrix, mode="r", pivoting=True)
    r, order = decomposition
    size = np.abs(np.diag(r))
    if not size.size or size[0] == 0.0:
        raise DataError("The recording determines no parameter: nothing moves or all is fixed.")
    rank = int((size > RELATIVE_RANK * size[0]).sum())
    scaled = linalg.solve_triangular(r[:rank, :rank], r[:rank])
    # Structural zeros should not be rounding errors of 1e-17.
    scaled[np.abs(scaled) < 1e-10] = 0.0
    inverse = np.divide(1.0, scales, out=np.zeros_like(scales), where=scales > 0.0)
    grouping = np.zeros((rank, len(scales)))
    grouping[:, order] = scales[order[:rank], None] * scaled * inverse[order]
    return order[:rank], grouping


def _scales(dynamics: MujocoInverseDynamics, nominal: Array) -> Array:
    """Returns the scale of each parameter, ``(P,)``, from its body or joint; never zero."""
    model = dynamics.model
    result = []
    for body in dynamics.bodies:
        mass = max(float(model.body_mass[body]), 1e-6 * float(model.body_mass.sum()))
        # Radius of gyration about the frame's origin, at least 1/1000 of the mechanism's size.
        centre = float(model.body_ipos[body] @ model.body_ipos[body])
        square = centre + float(model.body_inertia[body].sum()) / (2.0 * mass)
        square = max(square, (1e-3 * float(model.stat.extent)) ** 2)
        result += [mass, *[mass * np.sqrt(square)] * 3, *[mass * square] * 6]
    inertia = np.maximum(model.dof_M0, 1e-12)
    for dof in range(model.nv):
        # Scales of a joint that stops in one second, or that brakes by one unit of acceleration.
        own = nominal[len(result) : len(result) + 3]
        result += np.maximum(own, inertia[dof]).tolist()
    return np.array(result)
