"""Observations of the public tasks with draws from their exact posteriors.

The public reference posteriors exist for a few observations. All four tasks have a likelihood in
closed form, so that other observations can be drawn from the prior predictive distribution and
their posteriors sampled exactly, without a Markov chain: every draw is independent.

* two_moons: x is a point of a crescent plus a fold of theta that preserves areas. A draw of the
  crescent, subtracted from x, leaves the fold's value, and theta is one of its two pre-images.
* gaussian_linear: conjugate, N(x / 2, 0.05 I).
* gaussian_mixture: the likelihood is symmetric in x and theta, so that x plus noise is a draw.
* slcp: given the covariance S of the four readings, their mean m is Gaussian. What is left is a
  density of three parameters, (|theta_3|, |theta_4|, theta_5), which is sampled by rejection from
  its values on a grid. The signs of theta_3 and theta_4 are coin flips.

Draws outside of the prior's box are rejected.
"""

import math
from collections.abc import Callable

import torch
from tasks import TASKS, Reference, Task
from torch import Tensor

from npdr_ppl.randomness import seeded

__all__ = ["OBSERVATION_SETS", "make_reference", "sample_exactly", "slcp_log_likelihood"]

OBSERVATION_SETS = {"tune": range(101, 121), "test": range(201, 221)}
"""Numbers of the observations that are made here, each of which is its own seed. Options of the
backends were chosen with the first set; figures in the documentation are those of the second."""

CELLS = (48, 192, 96)
"""Cells of slcp's grid along log |theta_3 theta_4|, log |theta_3 / theta_4| and theta_5. Where the
correlation is strong the ratio is known best."""

ZOOMS = 2
"""Times that slcp's grid is restricted to the cells that are not negligible."""

MAX_RATIO = 1.5
"""Density anywhere in a cell of slcp's grid over its largest value at the cell's corners, at most:
the constant of the rejection sampling. A draw that exceeds it raises an error."""

NEGLIGIBLE = 25.0
"""Cells of slcp's grid whose log mass is so far below the largest one's are left out: all of them
together hold less than 1e-5 of the posterior."""


def make_reference(task: str, number: int, num_samples: int = 10_000) -> Reference:
    """Draws an observation from the prior predictive distribution, and its exact posterior.

    Args:
        task: Name of the task.
        number: Seed; see :data:`OBSERVATION_SETS`.
        num_samples: Draws from the posterior.
    """
    known = TASKS[task]
    with seeded(number, f"observation of {task}"):
        theta = known.to_theta(torch.randn(1, known.num_parameters))
        observation = known.simulate(theta)[0]
        return Reference(observation, theta[0], sample_exactly(known, observation, num_samples))


def sample_exactly(task: Task, observation: Tensor, num_samples: int) -> Tensor:
    """Draws independent samples of a task's posterior, ``(num_samples, d)``.

    Args:
        task: One of the public tasks.
        observation: Features x_o, ``(F,)``.
        num_samples: Number of draws.
    """
    propose = SAMPLERS[task.name](observation.double())
    chunks: list[Tensor] = []
    missing = num_samples
    while missing > 0:
        draws = propose(num_samples)
        if task.is_uniform:
            draws = draws[(draws.abs() < task.scale).all(-1)]
        chunks.append(draws[:missing])
        missing -= len(chunks[-1])
    return torch.cat(chunks).float()


Proposal = Callable[[int], Tensor]
"""Draws theta from a posterior whose prior is not cut off at its box; may return fewer draws."""


def _two_moons(x: Tensor) -> Proposal:
    def propose(n: int) -> Tensor:
        a = math.pi * (torch.rand(n).double() - 0.5)
        r = 0.1 + 0.01 * torch.randn(n).double()
        # sqrt(1/2) (theta_1 + theta_2) up to its sign, and sqrt(1/2) (theta_2 - theta_1)
        along = r * a.cos() + 0.25 - x[0]
        across = x[1] - r * a.sin()
        sign = torch.where(torch.rand(n) < 0.5, 1.0, -1.0)
        theta = torch.stack((sign * along - across, sign * along + across), -1) / math.sqrt(2)
        return theta[along > 0]

    return propose


def _gaussian_linear(x: Tensor) -> Proposal:
    return lambda n: 0.5 * x + math.sqrt(0.05) * torch.randn(n, len(x)).double()


def _gaussian_mixture(x: Tensor) -> Proposal:
    def propose(n: int) -> Tensor:
        scale = torch.where(torch.rand(n, 1) < 0.5, 1.0, 0.1)
        return x + scale * torch.randn(n, len(x)).double()

    return propose


def slcp_log_likelihood(theta: Tensor, x: Tensor) -> Tensor:
    """Returns log p(x | theta) of slcp, ``(n,)``, in float64.

    Args:
        theta: Parameters, ``(n, 5)``.
        x: Features, ``(8,)``: four readings of two channels.
    """
    theta = theta.double()
    s1, s2, rho = theta[:, 2] ** 2, theta[:, 3] ** 2, theta[:, 4].tanh()
    points = x.double().view(4, 2)
    e1 = (points[:, 0] - theta[:, :1]) / s1[:, None]
    e2 = (points[:, 1] - theta[:, 1:2]) / s2[:, None]
    free = 1 - rho**2
    square = (e1**2 - 2 * rho[:, None] * e1 * e2 + e2**2).sum(-1) / free
    return -0.5 * square - 4 * (s1.log() + s2.log() + 0.5 * free.log() + math.log(2 * math.pi))


def _slcp_marginal(shape: Tensor, scatter: Tensor) -> Tensor:
    """Returns the log of p(x, S) integrated over the mean m, up to a constant, ``(n,)``.

    Args:
        shape: log |theta_3 theta_4|, log |theta_3 / theta_4| and theta_5, ``(n, 3)``; the density
            is with respect to these, along which it is hardly correlated.
        scatter: Sums of squares and products of the readings about their mean, ``(2, 2)``.
    """
    # Logarithms of the standard deviations theta^2, in terms of product and ratio.
    l1, l2 = shape[:, 0] + shape[:, 1], shape[:, 0] - shape[:, 1]
    rho = shape[:, 2].tanh()
    free = 1 - rho**2
    square = (
        scatter[0, 0] * (-2 * l1).exp()
        - 2 * rho * scatter[0, 1] * (-l1 - l2).exp()
        + scatter[1, 1] * (-2 * l2).exp()
    ) / free
    # Four readings less the mean leave |S|^(-3/2); log |theta| has the Jacobian |theta|.
    return -0.5 * square - 3 * (l1 + l2 + 0.5 * free.log()) + 0.5 * (l1 + l2)


def _slcp(x: Tensor) -> Proposal:
    points = x.view(4, 2)
    centre = points.mean(0)
    scatter = (points - centre).T @ (points - centre)
    bound = torch.tensor(TASKS["slcp"].scale).double()
    largest = bound.log()
    # |S|^(-1/2) exp(-scatter / 2 S) vanishes for standard deviations far below the readings'.
    least = 0.5 * (scatter.diagonal() / 4).sqrt().log() - 1.5
    low = torch.stack((least.sum(), least[0] - largest, -bound))
    high = torch.stack((2 * largest, largest - least[1], bound))
    for _ in range(ZOOMS):
        width, log_bound, centres = _slcp_cells(low, high, scatter)
        kept = centres[log_bound > log_bound.max() - NEGLIGIBLE]
        low, high = kept.min(0).values - 0.5 * width, kept.max(0).values + 0.5 * width
    width, log_bound, centres = _slcp_cells(low, high, scatter)

    def propose(n: int) -> Tensor:
        chosen = torch.multinomial((log_bound - log_bound.max()).exp(), n, replacement=True)
        shape = centres[chosen] + width * (torch.rand(n, 3).double() - 0.5)
        ratio = (_slcp_marginal(shape, scatter) - log_bound[chosen]).exp()
        if float(ratio.max()) > MAX_RATIO:
            raise ValueError(f"slcp's grid is too coarse: a cell varies by {float(ratio.max())}.")
        shape = shape[MAX_RATIO * torch.rand(n) < ratio]
        root = 0.5 * torch.stack((shape[:, 0] + shape[:, 1], shape[:, 0] - shape[:, 1]), -1)
        root, rho = root.exp(), shape[:, 2].tanh()  # |theta_3| and |theta_4|
        e1, e2 = torch.randn(2, len(shape)).double() / 2  # the mean of four readings
        m1 = centre[0] + root[:, 0] ** 2 * e1
        m2 = centre[1] + root[:, 1] ** 2 * (rho * e1 + (1 - rho**2).sqrt() * e2)
        signs = torch.where(torch.rand(len(shape), 2) < 0.5, 1.0, -1.0)
        theta = torch.cat((signs * root, shape[:, 2:]), -1)
        return torch.cat((m1[:, None], m2[:, None], theta), -1)

    return propose


def _slcp_cells(low: Tensor, high: Tensor, scatter: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Divides a box into cells.

    Returns:
        Their width, ``(3,)``, the largest log density at a cell's corners, ``(n,)``, and their
        centres, ``(n, 3)``.
    """
    width = (high - low) / torch.tensor(CELLS)
    edges = [low[k] + width[k] * torch.arange(CELLS[k] + 1) for k in range(3)]
    corners = _slcp_marginal(torch.cartesian_prod(*edges), scatter)
    corners = corners.view(1, 1, *(count + 1 for count in CELLS))
    log_bound = torch.nn.functional.max_pool3d(corners, kernel_size=2, stride=1).flatten()
    centres = torch.cartesian_prod(*(edge[:-1] for edge in edges)) + 0.5 * width
    return width, log_bound, centres


SAMPLERS: dict[str, Callable[[Tensor], Proposal]] = {
    "two_moons": _two_moons,
    "gaussian_linear": _gaussian_linear,
    "gaussian_mixture": _gaussian_mixture,
    "slcp": _slcp,
}
