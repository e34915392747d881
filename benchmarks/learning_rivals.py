"""What others would do instead of learning a law: a sparse or a Gaussian-process residual force.

Both are fitted to the force that the refitted model lacks along the recording, by inverse
dynamics; see :mod:`residual_forces`. Both know position, velocity and drive of the joint that
lacks most.

* ``pysindy``: sequentially thresholded least squares (Brunton, Proctor and Kutz 2016) on
  polynomials to degree three, |v|v, sign v, and sine and cosine of angles; as many terms as BIC
  likes best.
* ``gp``: scikit-learn's Gaussian process with a squared exponential kernel and noise, on as many
  samples as it can handle.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyro.distributions as dist
import torch
from residual_forces import Array, residual_forces
from sparse_regression import least_squares, select
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.recorded_motion import motion_at_ports
from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Joint
from npdr_ppl.language.effects import ForceEffect
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.rollouts import Rollouts

__all__ = ["rival_models"]

MOST_SAMPLES = 800
"""Samples of a Gaussian process: its cost grows with their cube."""

Force = Callable[[Array], Array]
"""Maps position, velocity and drive, ``(n, 3)``, to the missing force, ``(n,)``."""


class _Residual(ForceEffect):
    """A force that is any function of position, velocity and drive."""

    id = "residual"
    needs_joint = True
    parameters = (Parameter("share", "1", 0.0, "of the force"),)

    def __init__(self, port: str, law: Force) -> None:
        super().__init__(port)
        self.law = law

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        return {"share": dist.Normal(torch.tensor(1.0).double(), 1e-9)}

    def begin_step(
        self, joint: Joint, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> Tensor:
        columns = torch.broadcast_tensors(joint.position, joint.velocity, joint.drive)
        found = self.law(torch.stack(columns, dim=-1).double().reshape(-1, 3).numpy())
        return torch.from_numpy(found).reshape(columns[0].shape).to(columns[0])

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor | None:
        return memory


def rival_models(start: Hypothesis, recorded: Rollouts) -> dict[str, Hypothesis]:
    """Returns the model with each residual force, by the name of the method.

    Args:
        start: The model, its parameters fitted.
        recorded: The recording.
    """
    found = residual_forces(start, recorded)
    forces = found.filtered(found.forces)
    rated = np.array([port.rated for port in found.ports])
    joint = int((forces.std(0) / rated).argmax())
    port = found.ports[joint]
    motion = next(m for m in motion_at_ports(start) if m.port.name == port.name)
    gain = _gain(start, motion.values.get("tau"))
    columns = found.filtered(
        [
            np.column_stack((m.positions[:, joint], m.velocities[:, joint], m.actions @ gain))
            for m in found.motions
        ]
    )
    result = {}
    for name, fit in (("pysindy", _sparse), ("gp", _process)):
        law = fit(columns, forces[:, joint], port.coordinate == "rad")
        model = add_effect(start.model, _Residual(port.name, law))
        z = torch.cat((start.fit.z, torch.zeros(1, dtype=torch.float64)))
        result[name] = Hypothesis(model, start.effects, start.segments, replace(start.fit, z=z))
    return result


def _gain(start: Hypothesis, drive: Tensor | None) -> Array:
    """Returns the drive's force per command, by least squares."""
    actions = start.segments.inputs.actions.double().flatten(0, 1).numpy()
    if drive is None:
        return np.zeros(actions.shape[1])
    return np.linalg.lstsq(actions, drive.flatten().numpy(), rcond=None)[0]


def _library(x: Array, is_angle: bool) -> Array:
    q, v, _ = x.T
    powers = [
        np.prod([x[:, k] for k in chosen], axis=0)
        for degree in (1, 2, 3)
        for chosen in itertools.combinations_with_replacement(range(3), degree)
    ]
    more = [np.ones_like(q), np.abs(v) * v, np.sign(v)]
    return np.stack([*powers, *more, *([np.sin(q), np.cos(q)] if is_angle else [])], axis=1)


def _sparse(x: Array, force: Array, is_angle: bool) -> Force:
    columns = _library(x, is_angle)
    chosen = select(columns, force)
    coefficients = least_squares(columns[:, chosen], force).coefficients

    def law(at: Array) -> Array:
        return _library(at, is_angle)[:, chosen] @ coefficients

    return law


def _process(x: Array, force: Array, is_angle: bool) -> Force:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    mean, spread, size = x.mean(0), x.std(0).clip(1e-12), force.std()
    few = np.random.default_rng(0).permutation(len(x))[:MOST_SAMPLES]
    kernel = ConstantKernel(1.0) * RBF(np.ones(3)) + WhiteKernel(0.5)
    process = GaussianProcessRegressor(kernel, random_state=0)
    process.fit((x[few] - mean) / spread, force[few] / size)

    def law(at: Array) -> Array:
        return size * process.predict((at - mean) / spread)

    return law
