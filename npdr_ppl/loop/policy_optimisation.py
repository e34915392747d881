"""POLOPT of Algorithm 1: a policy search that evaluates policies in many domains at once.

``policy_training.py`` calls it and decides what follows.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.risk import MeanReturn, Risk
from npdr_ppl.policies.base import Policy
from npdr_ppl.policies.policy_search import PolicySearch, SearchState
from npdr_ppl.randomness import derived_seed

__all__ = ["OptimisedPolicy", "optimise_policy", "returns_of"]


@dataclass(frozen=True)
class OptimisedPolicy:
    """The result of a policy search.

    Attributes:
        parameters: Parameters of the policy to deploy, ``(P,)`` in float64.
        policy: The policy.
        best_returns: Best objective among the candidates of each iteration: by default the mean
            return over the domains.
        mean_return: Mean return of ``policy`` over its training domains.
        success_rate: Share of these episodes that succeeded; NaN if the task has no threshold.
    """

    parameters: Tensor
    policy: Policy
    best_returns: tuple[float, ...]
    mean_return: float
    success_rate: float

    def figures(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        parameters = self.policy.parameters.tolist()
        return {
            "policy": dict(zip(self.policy.names, parameters, strict=True)),
            "sim_return": self.mean_return,
            "sim_success": self.success_rate,
            "best_returns": list(self.best_returns),
        }


def optimise_policy(
    task: ControlTask,
    domains: Domains,
    search: PolicySearch[Any],
    start: Tensor,
    *,
    iterations: int,
    num_initial_states: int,
    seed: int,
    risk: Risk | None = None,
    internal_model: Mapping[str, float] | None = None,
    expected_calls: int | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> OptimisedPolicy:
    """Searches for the policy with the greatest return over domains and initial states.

    To make the comparison fair, all candidates run in the same domains and, within an iteration,
    from the same initial states.

    Args:
        task: The task of the policy.
        domains: The D domains.
        search: The search.
        start: Initial policy parameters, ``(P,)``.
        iterations: Iterations of the search.
        num_initial_states: Number S of initial states in each iteration.
        seed: Seed of all random numbers.
        risk: Reduces the returns in all domains to one number; ``None`` for their mean.
        internal_model: Parameters of the policies' internal model, the same in every domain, as
            on the target; ``None`` for each domain's own parameters.
        expected_calls: Expected number of iterations of this size, if more than ``iterations``.
        progress: Called with the fraction done and a short status.
    """
    objective = risk or MeanReturn()
    state: SearchState = search.init(task.policy.with_parameters(start.to(task.policy.parameters)))
    best = []
    for iteration in range(iterations):
        stream = torch.Generator().manual_seed(derived_seed(seed, "policy search", iteration))
        candidates = search.ask(state, stream)
        if progress is not None and iteration == 0:
            progress(0.0, f"the first {len(candidates)} policies in {len(domains)} domains")
        starts = task.initial_states(num_initial_states, stream)
        returns = returns_of(
            task,
            domains,
            candidates,
            starts,
            internal_model=internal_model,
            expected_calls=expected_calls or iterations,
        )
        values = objective(returns.double().mean(2))
        state = search.tell(state, candidates, values)
        best.append(float(values.max()))
        if progress is not None:
            progress((iteration + 1) / iterations, f"return {best[-1]:.0f}")
    # The search's own estimate, such as PoWER's mean, may never have been evaluated.
    finalists = torch.stack((search.parameters(state), state.best))
    stream = torch.Generator().manual_seed(derived_seed(seed, "policy evaluation"))
    starts = task.initial_states(num_initial_states, stream)
    returns = returns_of(task, domains, finalists, starts, internal_model=internal_model).double()
    winner = int(objective(returns.mean(2)).argmax())
    success = math.nan
    if task.success is not None:
        success = float((returns[winner] > task.success).double().mean())
    parameters = finalists[winner]
    return OptimisedPolicy(
        parameters,
        task.policy.with_parameters(parameters.to(task.policy.parameters)),
        tuple(best),
        float(returns[winner].mean()),
        success,
    )


def returns_of(
    task: ControlTask,
    domains: Domains,
    candidates: Tensor,
    initial_states: Tensor,
    *,
    internal_model: Mapping[str, float] | None = None,
    expected_calls: int = 1,
) -> Tensor:
    """Returns the return of every candidate in every domain, ``(P, D, S)``, in float32.

    Args:
        task: The task of the policy.
        domains: The D domains.
        candidates: Policy parameters, ``(P, parameters)``.
        initial_states: True states at the start, ``(S, states)``.
        internal_model: Parameters of the policies' internal model, the same in every domain;
            ``None`` for each domain's own parameters.
        expected_calls: Expected number of calls of this size.
    """
    policy = task.policy.with_parameters(candidates.float()[:, None, None])
    parameters = {name: value.float()[:, None] for name, value in domains.parameters.items()}
    episodes = domains.simulator.roll_out(
        parameters,
        policy,
        initial_states.float(),
        task.num_steps,
        reward=task.reward,
        expected_calls=expected_calls,
        internal_model=internal_model,
    )
    assert episodes.returns is not None
    return episodes.returns
