"""The check before deploying: does a new policy work in the simulators that the data leave?

A policy that fails in many draws of the posterior fails on the target just as likely, if the model
is right. To find that out in simulation costs seconds, on a device a rollout or a part.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import torch

from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import domains_at
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.loop.policy_optimisation import returns_of
from npdr_ppl.policies.base import Policy
from npdr_ppl.posterior.posterior import Posterior

__all__ = ["Check", "NextStep", "check_policy", "decide"]


class NextStep(StrEnum):
    """What to do with a new policy."""

    DEPLOY = "deploy"
    SEARCH_AGAIN = "search again"
    ANOTHER_ROLLOUT = "another rollout"
    TRAIN_FOR_THE_TAIL = "train for the worst domains"


@dataclass(frozen=True)
class Check:
    """What a policy reached over the posterior, run as it would be on the target.

    Attributes:
        success: Share of the draws in which its mean return is above the task's threshold; NaN
            without one.
        mean_return: Mean of the returns in all draws.
        tail_return: Mean of the returns in the worst share of them.
        num_draws: Number of draws.
    """

    success: float
    mean_return: float
    tail_return: float
    num_draws: int

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> "Check":
        """Returns a check as JSON has it, where numbers that are not finite are ``None``."""
        success = math.nan if saved["success"] is None else saved["success"]
        mean, tail = (
            -math.inf if saved[name] is None else saved[name]
            for name in ("mean_return", "tail_return")
        )
        return cls(success, mean, tail, saved["num_draws"])

    def is_better_than(self, other: "Check") -> bool:
        """Returns whether more draws succeed, or as many and the worst of them are better."""
        return (self.success, self.tail_return) > (other.success, other.tail_return)

    def to_dict(self) -> dict[str, Any]:
        """Returns the keys that ``train.json`` has."""
        return {
            "simulated_success": self.success,
            "simulated_return": {"mean": self.mean_return, "cvar": self.tail_return},
        }


def check_policy(
    task: ControlTask,
    policy: Policy,
    posterior: Posterior,
    internal_model: Mapping[str, float],
    options: LoopOptions,
    *,
    seed: int,
) -> Check:
    """Runs a policy in many draws of the posterior at once.

    The draws are not spread: this asks what the data say, while training guards against more. The
    policy's own model is that which it would have on the target, the same in all draws.

    Args:
        task: What the policy is to do.
        policy: The policy.
        posterior: The posterior.
        internal_model: Parameters of the policy's own model on the target.
        options: Number of draws and of initial states in each, share of the worst draws.
        seed: Seed of the draws and of the initial states.
    """
    generator = torch.Generator().manual_seed(seed)
    starts = task.initial_states(options.num_initial_states, generator)
    domains = domains_at(posterior.prior, posterior.sample_mixture(options.num_checked, seed=seed))
    returns = returns_of(
        task, domains, policy.parameters[None], starts, internal_model=internal_model
    )[0]
    # A simulation that diverged is a failure.
    by_draw = returns.double().mean(1).nan_to_num(nan=-math.inf)
    success = math.nan
    if task.success is not None:
        success = float((by_draw > task.success).double().mean())
    return Check(success, float(by_draw.mean()), float(options.tail(by_draw)), len(by_draw))


def decide(
    check: Check,
    options: LoopOptions,
    *,
    searches_left: int,
    rollouts_left: int,
    is_for_tail: bool,
) -> tuple[NextStep, str]:
    """Returns what to do with a policy, and why in a sentence.

    Args:
        check: What it reached in simulation.
        options: The share of successes that is asked for.
        searches_left: Searches for a policy that can still be begun anew.
        rollouts_left: Rollouts that can still be recorded.
        is_for_tail: Whether it has been trained for the worst domains.
    """
    if math.isnan(check.success):
        return NextStep.DEPLOY, "The task has no threshold of success to check the policy by."
    shown = f"The policy succeeds in {check.success:.0%} of {check.num_draws} draws"
    least = f"the {options.least_success:.0%} asked for"
    if check.success >= options.least_success:
        return NextStep.DEPLOY, f"{shown}, at least {least}."
    if not options.follows_decisions:
        return NextStep.DEPLOY, f"{shown}, fewer than {least}; decisions are only logged."
    if is_for_tail:
        return NextStep.DEPLOY, (
            f"{shown}, fewer than {least}, also after training for the worst "
            f"{options.tail_share:.0%} of the domains, and no rollout is left to ask for."
        )
    if 1.0 - check.success >= options.least_success and searches_left > 0:
        return NextStep.SEARCH_AGAIN, (
            f"{shown}: it fails whatever the parameters are within their uncertainty, so that a "
            "better policy is searched for from another start."
        )
    if rollouts_left > 0:
        return NextStep.ANOTHER_ROLLOUT, (
            f"{shown}, fewer than {least}: record a rollout that tells more about the parameters."
        )
    return NextStep.TRAIN_FOR_THE_TAIL, (
        f"{shown}, fewer than {least}, and no rollout is left to ask for: train for the worst "
        f"{options.tail_share:.0%} of the domains."
    )
