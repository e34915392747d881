"""The check before deploying: does a new policy work in simulators drawn from the posterior?

If the model is right, the share of posterior draws in which a policy fails is its probability of
failure on the target. A check in simulation costs seconds; on a device, a failure costs a rollout
or a broken part.
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
    """The next step for a new policy."""

    DEPLOY = "deploy"
    SEARCH_AGAIN = "search again"
    ANOTHER_ROLLOUT = "another rollout"
    TRAIN_FOR_THE_TAIL = "train for the worst domains"


@dataclass(frozen=True)
class Check:
    """A policy's returns over the posterior, when it runs as it would on the target.

    Attributes:
        success: Share of its episodes, over draws and initial states, whose return is above the
            task's threshold; NaN if the task has no threshold.
        reliable_share: Share of the draws in which the required share of episodes succeed; NaN
            if the task has no threshold.
        mean_return: Mean of the returns in all draws.
        tail_return: Mean of the returns in the worst share of the draws.
        num_draws: Number of draws.
    """

    success: float
    reliable_share: float
    mean_return: float
    tail_return: float
    num_draws: int

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> "Check":
        """Reads a check from JSON, in which numbers that are not finite are ``None``."""
        success, reliable_share = (
            math.nan if saved[name] is None else saved[name]
            for name in ("success", "reliable_share")
        )
        mean, tail = (
            -math.inf if saved[name] is None else saved[name]
            for name in ("mean_return", "tail_return")
        )
        return cls(success, reliable_share, mean, tail, saved["num_draws"])

    def is_better_than(self, other: "Check") -> bool:
        """Returns whether more episodes succeed, or as many and the worst draws are better."""
        return (self.success, self.tail_return) > (other.success, other.tail_return)

    def to_dict(self) -> dict[str, Any]:
        """Returns the check with the keys of ``train.json``."""
        return {
            "simulated_success": self.success,
            "reliable_share": self.reliable_share,
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

    The draws are not spread, because the check tests the posterior itself; training protects
    against more. The policy's internal model is the one it would have on the target, the same in
    all draws.

    Args:
        task: The task of the policy.
        policy: The policy.
        posterior: The posterior.
        internal_model: Parameters of the policy's internal model on the target.
        options: Number of draws, number of initial states in each, required share of successes,
            and share of the worst draws.
        seed: Seed of the draws and of the initial states.
    """
    generator = torch.Generator().manual_seed(seed)
    starts = task.initial_states(options.num_checked_states, generator)
    domains = domains_at(posterior.prior, posterior.sample_mixture(options.num_checked, seed=seed))
    returns = returns_of(
        task, domains, policy.parameters[None], starts, internal_model=internal_model
    )[0]
    # A simulation that diverged is a failure.
    by_draw = returns.double().mean(1).nan_to_num(nan=-math.inf)
    success, reliable_share = math.nan, math.nan
    if task.success is not None:
        shares = (returns > task.success).double().mean(1)
        success = float(shares.mean())
        reliable_share = float((shares >= options.least_success).double().mean())
    return Check(
        success, reliable_share, float(by_draw.mean()), float(options.tail(by_draw)), len(by_draw)
    )


def decide(
    check: Check,
    options: LoopOptions,
    *,
    searches_left: int,
    rollouts_left: int,
    is_for_tail: bool,
) -> tuple[NextStep, str]:
    """Returns the next step for a policy, and the reason in a sentence.

    Args:
        check: Its results in simulation.
        options: The required share of successes.
        searches_left: Number of times that the policy search can still be restarted.
        rollouts_left: Number of rollouts that can still be recorded.
        is_for_tail: Whether it has been trained for the worst domains.
    """
    if math.isnan(check.success):
        return NextStep.DEPLOY, "The policy is not checked: the task has no success threshold."
    shown = f"The policy succeeds in {check.success:.0%} of its episodes ({check.num_draws} draws)"
    least = f"the {options.least_success:.0%} asked for"
    if check.success >= options.least_success:
        return NextStep.DEPLOY, f"{shown}, at least {least}."
    if not options.follows_decisions:
        return NextStep.DEPLOY, f"{shown}, fewer than {least}; decisions are only logged."
    if is_for_tail:
        return NextStep.DEPLOY, (
            f"{shown}, fewer than {least}, even after training for the worst "
            f"{options.tail_share:.0%} of the domains, and no extra rollout is left."
        )
    if 1.0 - check.reliable_share >= options.least_success and searches_left > 0:
        return NextStep.SEARCH_AGAIN, (
            f"{shown}, and is reliable in {check.reliable_share:.0%} of the draws. It fails for "
            "nearly all likely parameters, so uncertain parameters are not the cause. The search "
            "is restarted from the task's own policy."
        )
    if rollouts_left > 0:
        return NextStep.ANOTHER_ROLLOUT, (
            f"{shown}, fewer than {least}: record a rollout with more information about the "
            "parameters."
        )
    return NextStep.TRAIN_FOR_THE_TAIL, (
        f"{shown}, fewer than {least}, and no extra rollout is left: train for the worst "
        f"{options.tail_share:.0%} of the domains."
    )
