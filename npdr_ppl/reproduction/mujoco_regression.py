"""Bayesian linear regression of any MJCF's inertial and friction parameters.

No motion tells all ten inertial parameters of every body: the regressor's columns are linearly
dependent. A rank-revealing QR with column pivoting finds the base parameters β = K π that a
recording tells (Gautier 1991), the conjugate posterior is over these, and each draw is carried to
the physical parameters π of least change from the nominal ones. Draws that no body can have are
counted.

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
"""Least diagonal entry of R that counts, relative to the largest: what no motion tells is zero to
1e-13, and what this motion tells less than this is lost in any noise."""


@dataclass(frozen=True)
class MjcfPosterior:
    """Posterior over the parameters of an MJCF.

    Attributes:
        dynamics: The model's inverse dynamics.
        names: Names of its parameters π, P of them.
        base_names: The parameter that each base parameter β stands for, r of them; the others in
            its row of ``grouping`` go along with it.
        grouping: K with β = K π, ``(r, P)``.
        base: Posterior over β.
        nominal: π of the model as it stands, ``(P,)``.
        scales: Size of each π in which changes are measured, ``(P,)``; zero for fixed ones.
    """

    dynamics: MujocoInverseDynamics
    names: tuple[str, ...]
    base_names: tuple[str, ...]
    grouping: Array
    base: StudentT
    nominal: Array
    scales: Array

    def to_physical(self, base: Array) -> Array:
        """Returns the π of least change from the nominal ones that have these β.

        The change is measured by ‖(π − π₀)/s‖ with the scales s.

        Args:
            base: Base parameters, ``(n, r)``.

        Returns:
            Parameters, ``(n, P)``, of which some may be impossible.
        """
        inverse = self.scales[:, None] * np.linalg.pinv(self.grouping * self.scales)
        return self.nominal + (base - self.grouping @ self.nominal) @ inverse.T

    def mean(self) -> dict[str, float]:
        """Returns π at the mean of β, by name."""
        values = self.to_physical(self.base.mean.numpy()[None])[0]
        return dict(zip(self.names, values.tolist(), strict=True))

    def draw(self, num_draws: int, *, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
        """Draws from the posterior, the impossible ones included, which are counted and logged.

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
    """Regresses an MJCF's parameters on a motion that is known at N instants.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel``; its parameters are nominal.
        positions: MuJoCo's qpos, ``(N, nq)``.
        velocities: Its qvel, ``(N, nv)``.
        accelerations: Its qacc, ``(N, nv)``.
        applied: Applied generalised forces, those of actuators included, ``(N, nv)``.
        fixed: Patterns of the names of parameters that are known to be nominal, e.g.
            ``"*.armature"``. A joint without damping is best told so: half of what noise makes
            of it would be negative, hence implausible.
        prior_spread: Standard deviation of the prior about the nominal values, in scales of the
            parameters, where the noise is as great as what the fit leaves.

    Raises:
        ModelError: The model has no joints, or equality constraints, or no such parameter.
        ShapeError: The shapes do not fit the model.
        DataError: Nothing moves, or nothing is left to find.
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
        positions: Position readings, ``(T + 1, nq)``.
        controls: Controls, each held for one step, ``(T, nu)``.
        time_step: Seconds between readings.
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
    # What does not change has no size of change.
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
    """Returns which names some pattern matches, ``(P,)``."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ModelError(f"No parameter is called {pattern!r}; there are {', '.join(names)}.")
    return np.array([any(fnmatchcase(name, pattern) for pattern in patterns) for name in names])


def _base(rows: Array, scales: Array) -> tuple[NDArray[np.int64], Array]:
    """Returns the independent columns, ``(r,)``, and K, ``(r, P)``.

    With W S P = Q [R₁ R₂; 0 0], the columns behind the first r are W_d = W_b R₁⁻¹ R₂ in scaled
    units, so that their parameters go along with those of the first: β = π_b + R₁⁻¹ R₂ π_d.
    """
    matrix = (rows * scales).reshape(-1, rows.shape[-1])
    decomposition: Any = linalg.qr(matrix, mode="r", pivoting=True)
    r, order = decomposition
    size = np.abs(np.diag(r))
    if not size.size or size[0] == 0.0:
        raise DataError("The recording tells no parameter, because nothing moves or all is fixed.")
    rank = int((size > RELATIVE_RANK * size[0]).sum())
    scaled = linalg.solve_triangular(r[:rank, :rank], r[:rank])
    # What is zero by structure should not be 1e-17.
    scaled[np.abs(scaled) < 1e-10] = 0.0
    inverse = np.divide(1.0, scales, out=np.zeros_like(scales), where=scales > 0.0)
    grouping = np.zeros((rank, len(scales)))
    grouping[:, order] = scales[order[:rank], None] * scaled * inverse[order]
    return order[:rank], grouping


def _scales(dynamics: MujocoInverseDynamics, nominal: Array) -> Array:
    """Returns the size of each parameter, ``(P,)``: that of its body or joint, never zero."""
    model = dynamics.model
    result = []
    for body in dynamics.bodies:
        mass = max(float(model.body_mass[body]), 1e-6 * float(model.body_mass.sum()))
        # Radius of gyration about the frame's origin, at least a thousandth of the mechanism.
        centre = float(model.body_ipos[body] @ model.body_ipos[body])
        square = centre + float(model.body_inertia[body].sum()) / (2.0 * mass)
        square = max(square, (1e-3 * float(model.stat.extent)) ** 2)
        result += [mass, *[mass * np.sqrt(square)] * 3, *[mass * square] * 6]
    inertia = np.maximum(model.dof_M0, 1e-12)
    for dof in range(model.nv):
        # A joint that stops in a second, or that brakes by a unit of acceleration.
        own = nominal[len(result) : len(result) + 3]
        result += np.maximum(own, inertia[dof]).tolist()
    return np.array(result)
