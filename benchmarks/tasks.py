"""Four public inference tasks with known posteriors, and the test that scores against them.

The tasks, their observations and reference posteriors are those of Lueckmann et al. (2021),
*Benchmarking Simulation-Based Inference*, https://arxiv.org/abs/2101.04653. Each is written as a
batched torch simulator and as a map between its parameters theta and reference coordinates z, in
which the prior is N(0, I): a uniform prior U(a, b) becomes z = Phi^-1((theta - a) / (b - a)).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

__all__ = ["DATA", "TASKS", "Reference", "Task", "load_reference"]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@dataclass(frozen=True)
class Task:
    """A simulator with a prior whose coordinates are independent.

    Attributes:
        name: Folder name of the reference data.
        num_parameters: Dimension d of theta.
        scale: Half width of a uniform prior around zero, or standard deviation of a normal one.
        is_uniform: Which of the two.
        simulate: Maps theta, ``(n, d)``, to observations, ``(n, F)``.
    """

    name: str
    num_parameters: int
    scale: float
    is_uniform: bool
    simulate: Callable[[Tensor], Tensor]

    def to_theta(self, z: Tensor) -> Tensor:
        """Maps reference coordinates ``(n, d)`` to parameters ``(n, d)``."""
        return self.scale * (torch.erf(z / math.sqrt(2)) if self.is_uniform else z)

    def to_z(self, theta: Tensor) -> Tensor:
        """Maps parameters ``(n, d)`` to reference coordinates ``(n, d)``."""
        u = theta / self.scale
        return math.sqrt(2) * torch.erfinv(u) if self.is_uniform else u


@dataclass(frozen=True)
class Reference:
    """One observation of a task and what is known about its posterior.

    Attributes:
        observation: Features x_o, ``(F,)``.
        parameters: Parameters that generated it, ``(d,)``.
        samples: Draws from the exact posterior, ``(10000, d)``.
    """

    observation: Tensor
    parameters: Tensor
    samples: Tensor


def two_moons(theta: Tensor) -> Tensor:
    """Simulates a crescent whose position folds theta: ``(n, 2)`` to ``(n, 2)``."""
    a = math.pi * (torch.rand(len(theta)) - 0.5)
    r = 0.1 + 0.01 * torch.randn(len(theta))
    crescent = torch.stack((r * a.cos() + 0.25, r * a.sin()), dim=-1)
    fold = torch.stack((-theta.sum(-1).abs(), theta[:, 1] - theta[:, 0]), dim=-1)
    return crescent + fold / math.sqrt(2)


def gaussian_linear(theta: Tensor) -> Tensor:
    """Simulates x ~ N(theta, 0.1 I): ``(n, 10)`` to ``(n, 10)``."""
    return theta + math.sqrt(0.1) * torch.randn_like(theta)


def gaussian_mixture(theta: Tensor) -> Tensor:
    """Simulates x ~ N(theta, I) / 2 + N(theta, 0.01 I) / 2: ``(n, 2)`` to ``(n, 2)``."""
    scale = torch.where(torch.rand(len(theta), 1) < 0.5, 1.0, 0.1)
    return theta + scale * torch.randn_like(theta)


def slcp(theta: Tensor) -> Tensor:
    """Simulates four draws of N(m, S) with a simple likelihood: ``(n, 5)`` to ``(n, 8)``."""
    s1, s2, rho = theta[:, 2:3] ** 2, theta[:, 3:4] ** 2, theta[:, 4:5].tanh()
    e1, e2 = torch.randn(2, len(theta), 4)
    x1 = theta[:, 0:1] + s1 * e1
    x2 = theta[:, 1:2] + s2 * (rho * e1 + (1 - rho**2).clamp(min=0).sqrt() * e2)
    return torch.stack((x1, x2), dim=-1).flatten(1)


TASKS = {
    task.name: task
    for task in (
        Task("two_moons", 2, 1.0, True, two_moons),
        Task("gaussian_linear", 10, math.sqrt(0.1), False, gaussian_linear),
        Task("gaussian_mixture", 2, 10.0, True, gaussian_mixture),
        Task("slcp", 5, 3.0, True, slcp),
    )
}


def load_reference(task: str, observation: int, data: Path = DATA) -> Reference:
    """Loads an observation and its reference posterior.

    Args:
        task: Name of the task.
        observation: Number of the observation, from 1.
        data: Folder that holds ``sbibm/<task>/observation_<k>``.

    Raises:
        FileNotFoundError: The data are not there.
    """
    folder = data / "sbibm" / task / f"observation_{observation}"
    if not folder.is_dir():
        raise FileNotFoundError(f"There are no reference posteriors in {folder}.")

    def read(name: str) -> Tensor:
        table = np.loadtxt(folder / name, delimiter=",", skiprows=1, ndmin=2)
        return torch.as_tensor(table, dtype=torch.float32)

    return Reference(
        read("observation.csv")[0],
        read("true_parameters.csv")[0],
        read("reference_posterior_samples.csv.bz2"),
    )
