"""The inference methods that are compared: this package's backends and those of sbi.

A method is named ``ours:<backend>`` or ``sbi:<name>``. Each is a function that fits a task and
returns a sampler, which draws parameters given an observation. Everybody gets the same number of
simulations and otherwise their own defaults.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tasks import Task
from torch import Tensor

from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend, backends

__all__ = ["PEERS", "Fit", "Sampler", "default_methods", "find_method"]

Sampler = Callable[[Tensor, int], Tensor]
"""Draws parameters theta, ``(num_samples, d)``, given an observation ``(F,)`` and their number."""

Fit = Callable[[Task, Tensor, int, int], Sampler]
"""Fits a task for an observation in a number of rounds with so many simulations in all."""

MCABC_QUANTILE = 0.01
"""Share of the simulations that sbi's rejection ABC accepts; it has no default of its own."""


def standard_normal_problem(task: Task, observation: Tensor) -> Problem:
    """States a task in reference coordinates."""
    normal = torch.distributions.Normal(0.0, 1.0)
    d = task.num_parameters
    return Problem(
        num_parameters=d,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: normal.log_prob(z).sum(-1),
    )


def fit_ours(name: str, task: Task, observation: Tensor, rounds: int, simulations: int) -> Sampler:
    """Fits one of this package's backends with its defaults."""
    method = backend(name)
    problem = standard_normal_problem(task, observation)
    state = method.init(problem)
    for _ in range(rounds):
        z = method.ask(problem, state, simulations // rounds)
        state, _ = method.tell(problem, state, z, task.simulate(task.to_theta(z)))

    def sample(x: Tensor, num_samples: int) -> Tensor:
        posterior = Mixture(method.densities(standard_normal_problem(task, x), state))
        return task.to_theta(posterior.sample(num_samples))

    return sample


def sbi_prior(task: Task) -> Any:
    """Returns a task's prior as sbi wants it."""
    from sbi.utils import BoxUniform

    bound = task.scale * torch.ones(task.num_parameters)
    if task.is_uniform:
        return BoxUniform(-bound, bound)
    return torch.distributions.MultivariateNormal(0 * bound, torch.diag(bound**2))


def fit_sbi(
    class_name: str,
    options: dict[str, Any],
    needs_proposal: bool,
    task: Task,
    observation: Tensor,
    rounds: int,
    simulations: int,
) -> Sampler:
    """Fits one of sbi's neural methods.

    Args:
        class_name: Its class in ``sbi.inference``.
        options: Its constructor's arguments where they are not the defaults.
        needs_proposal: Whether it is to be told which proposal the simulations came from, as
            posterior estimators are.
        task: The task.
        observation: Observation the rounds aim at.
        rounds: Number of rounds.
        simulations: Simulations of all rounds.
    """
    import sbi.inference

    prior = sbi_prior(task)
    method = getattr(sbi.inference, class_name)(prior, show_progress_bars=False, **options)
    proposal, posterior = prior, None
    for number in range(rounds):
        theta = proposal.sample((simulations // rounds,))
        source = {"proposal": proposal} if needs_proposal and number else {}
        method.append_simulations(theta, task.simulate(theta), **source).train()
        posterior = method.build_posterior()
        if number < rounds - 1:
            proposal = posterior.set_default_x(observation)
    assert posterior is not None
    return lambda x, n: posterior.sample((n,), x=x, show_progress_bars=False)


def fit_mcabc(task: Task, observation: Tensor, rounds: int, simulations: int) -> Sampler:
    """Prepares sbi's rejection ABC, which simulates anew for every observation."""
    from sbi.inference import MCABC

    if rounds > 1:
        raise ValueError("Rejection ABC has one round.")
    method = MCABC(
        task.simulate,
        sbi_prior(task),
        simulation_batch_size=simulations,
        show_progress_bars=False,
    )

    def sample(x: Tensor, num_samples: int) -> Tensor:
        density: Any = method(x, simulations, quantile=MCABC_QUANTILE, kde=True)
        return density.sample((num_samples,))

    return sample


SBI: dict[str, Fit] = {
    "npe-c": partial(fit_sbi, "NPE_C", {"density_estimator": "nsf"}, True),
    "npe-a": partial(fit_sbi, "NPE_A", {}, True),
    "npe-a-1": partial(fit_sbi, "NPE_A", {"num_components": 1}, True),
    "npe-mdn": partial(fit_sbi, "NPE_C", {"density_estimator": "mdn"}, True),
    "fmpe": partial(fit_sbi, "FMPE", {}, True),
    "nle": partial(fit_sbi, "NLE_A", {}, False),
    "nre": partial(fit_sbi, "NRE", {}, False),
    "mcabc": fit_mcabc,
}
"""sbi's methods: posterior estimation with splines, with a mixture corrected analytically (10
components by default, and 1) and with a mixture density network, flow matching, likelihood
estimation (a masked autoregressive flow), ratio estimation (NRE-B), rejection ABC."""

PEERS = {
    "snpe-c": ("npe-c",),
    "snpe-a": ("npe-a", "npe-a-1"),
    "bayessim": ("npe-mdn",),
    "fmpe": ("fmpe",),
    "nle": ("nle",),
    "nre": ("nre",),
    "abc": ("mcabc",),
}
"""What each backend is compared with; sbi has no BayesSim, whose nearest relative there is a
mixture density network."""


def default_methods() -> list[str]:
    """Returns all backends that have a peer, each followed by its peers."""
    known = backends()
    return [
        method
        for ours, theirs in PEERS.items()
        if ours in known
        for method in (f"ours:{ours}", *(f"sbi:{name}" for name in theirs))
    ]


def find_method(name: str) -> Fit:
    """Returns the function that fits a method.

    Raises:
        KeyError: There is no such method.
    """
    source, _, word = name.partition(":")
    if source == "ours" and word in backends():
        return partial(fit_ours, word)
    if source == "sbi" and word in SBI:
        return SBI[word]
    raise KeyError(f"There is no method {name!r}.")
