"""The exact posteriors of the public tasks, checked by other routes.

Every check compares a mean over draws with a value that was found without them. A limit of five
standard errors raises a false alarm once in 1.7 million comparisons.
"""

import math

import pytest
import torch
from exact_posteriors import (
    OBSERVATION_SETS,
    make_reference,
    sample_exactly,
    slcp_log_likelihood,
)
from tasks import TASKS
from torch import Tensor

NUM_STANDARD_ERRORS = 5.0


def statistics(theta: Tensor) -> Tensor:
    """Returns what the checks average: theta, its squares and its products, ``(n, k)``."""
    rows, columns = torch.tril_indices(theta.shape[1], theta.shape[1])
    products = theta[:, :, None] * theta[:, None]
    return torch.cat((theta, products[:, rows, columns]), -1).double()


def check_means(draws: Tensor, expected: Tensor, variance: Tensor | float = 0.0) -> None:
    """Checks that the draws' statistics have the expected means.

    Args:
        draws: Independent draws, ``(n, d)``.
        expected: Expected statistics, ``(k,)``.
        variance: Squared standard errors of the expected statistics, if they are estimates.
    """
    values = statistics(draws)
    error = (values.var(0) / len(values) + variance).sqrt()
    assert ((values.mean(0) - expected).abs() <= NUM_STANDARD_ERRORS * error).all()


def weighted_means(theta: Tensor, log_weight: Tensor) -> tuple[Tensor, Tensor]:
    """Returns importance-weighted means of the statistics and their squared standard errors."""
    weight = log_weight.double().softmax(0)[:, None]
    values = statistics(theta)
    mean = (weight * values).sum(0)
    return mean, (weight**2 * (values - mean) ** 2).sum(0)


def on_grid(task: str, x: Tensor, centre: Tensor, half: float) -> Tensor:
    """Returns the posterior's mean statistics of a task of two parameters by a grid's sum."""
    axis = torch.linspace(-half, half, 1201, dtype=torch.float64)
    theta = centre.double() + torch.cartesian_prod(axis, axis)
    theta = theta[(theta.abs() < TASKS[task].scale).all(-1)]
    if task == "gaussian_mixture":
        square = ((x - theta) ** 2).sum(-1)
        log_density = torch.stack((-0.5 * square, -50 * square + math.log(100))).logsumexp(0)
    else:
        # The crescent's density at the point that is left when the fold is taken away.
        fold = torch.stack((-theta.sum(-1).abs(), theta[:, 1] - theta[:, 0]), -1) / math.sqrt(2)
        point = x.double() - fold - torch.tensor([0.25, 0.0])
        radius = point.norm(dim=-1)
        log_density = -0.5 * ((radius - 0.1) / 0.01) ** 2 - radius.log()
        log_density[point[:, 0] < 0] = -torch.inf
    return weighted_means(theta, log_density)[0]


@pytest.mark.parametrize("x", [[-0.2, 0.1], [-1.1, -0.1], [0.3, 0.4]])
def test_two_moons_on_a_grid(x: list[float]) -> None:
    """The second observation's crescents end at the prior's corners."""
    torch.manual_seed(0)
    observation = torch.tensor(x)
    draws = sample_exactly(TASKS["two_moons"], observation, 20_000)
    assert draws.abs().max() < 1
    check_means(draws, on_grid("two_moons", observation, torch.zeros(2), 1.0))


@pytest.mark.parametrize("x", [[2.0, -3.0], [9.7, 9.9], [10.8, -4.0]])
def test_gaussian_mixture_on_a_grid(x: list[float]) -> None:
    """In the second and third, the box cuts off part of the components, unequally."""
    torch.manual_seed(1)
    observation = torch.tensor(x)
    draws = sample_exactly(TASKS["gaussian_mixture"], observation, 20_000)
    check_means(draws, on_grid("gaussian_mixture", observation, observation, 6.0))


@pytest.mark.slow
def test_gaussian_linear_by_importance() -> None:
    """Draws of the prior weighted by the likelihood have the same moments."""
    torch.manual_seed(2)
    task = TASKS["gaussian_linear"]
    x = 0.3 * torch.linspace(-1, 1, 10)
    draws = sample_exactly(task, x, 20_000)
    prior = task.to_theta(torch.randn(500_000, 10))
    log_weight = -((x - prior) ** 2).sum(-1) / 0.2
    check_means(draws, *weighted_means(prior, log_weight))


@pytest.mark.parametrize("number", [106, 113])
def test_slcp_by_importance(number: int) -> None:
    """Draws around the exact ones, weighted by the likelihood, have the same moments.

    The proposal's Gaussians are wider than the posterior, so that no weight is large; the signs
    of theta_3 and theta_4, on which the likelihood does not depend, are left out.
    """
    reference = make_reference("slcp", number, 20_000)
    torch.manual_seed(3)
    draws = reference.samples.clone()
    draws[:, 2:4] = draws[:, 2:4].abs()
    scale = 0.5 * draws.std(0)
    centres, kernels = draws[:300], 60_000
    proposed = centres[torch.randint(300, (kernels,))] + scale * torch.randn(kernels, 5)
    log_weight = slcp_log_likelihood(proposed, reference.observation)
    distance = torch.cdist(proposed / scale, centres / scale)
    log_weight = log_weight - (-0.5 * distance.double() ** 2).logsumexp(1)
    outside = (proposed.abs() >= 3).any(1) | (proposed[:, 2:4] <= 0).any(1)
    log_weight[outside] = -torch.inf
    weight = log_weight.softmax(0)
    assert 1 / (weight**2).sum() > 3000  # draws' worth, or the comparison says little
    check_means(draws, *weighted_means(proposed, log_weight))


@pytest.mark.slow
def test_slcp_likelihood_is_that_of_the_simulator() -> None:
    """Simulations have the likelihood's mean score, zero, at their parameters."""
    torch.manual_seed(4)
    theta = torch.tensor([0.5, -1.0, 1.2, 0.9, 0.6]).double()
    simulations = TASKS["slcp"].simulate(theta.float().expand(4000, 5))
    score = torch.func.jacrev(
        lambda t: torch.func.vmap(lambda x: slcp_log_likelihood(t[None], x)[0])(simulations)
    )(theta)
    error = score.std(0) / len(score) ** 0.5
    assert (score.mean(0).abs() <= NUM_STANDARD_ERRORS * error).all()


@pytest.mark.parametrize("task", TASKS)
def test_observations_repeat_and_differ(task: str) -> None:
    """A number always gives the same observation and draws, and another number others."""
    torch.manual_seed(5)
    first, again = make_reference(task, 101, 50), make_reference(task, 101, 50)
    assert torch.equal(first.observation, again.observation)
    assert torch.equal(first.samples, again.samples)
    assert not torch.equal(first.observation, make_reference(task, 201, 50).observation)


def test_sets_are_disjoint() -> None:
    """What options are chosen with is not what is reported."""
    assert not set(OBSERVATION_SETS["tune"]) & set(OBSERVATION_SETS["test"])
