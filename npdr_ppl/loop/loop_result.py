"""The result of a training run, and which of its policies to deploy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from npdr_ppl.language.model import Model
from npdr_ppl.policies.base import Policy
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.rollouts import Rollouts

__all__ = ["Training", "Tried", "best_measured"]


@dataclass(frozen=True)
class Training:
    """The result of a training run.

    Attributes:
        policy: The policy to deploy.
        domain: Parameters of its internal model.
        deployed: Number of the iteration whose rollouts measured the policy's return; ``None``
            for the last policy, which has not run on the target.
        iterations: The records of the iterations, as in ``train.json``.
        rollouts: All real rollouts.
        posterior: The last posterior; ``None`` if no iteration was computed in this process.
        model: The model with the effects that were added.
    """

    policy: Policy
    domain: dict[str, float]
    deployed: int | None
    iterations: list[dict[str, Any]]
    rollouts: Rollouts
    posterior: Posterior | None
    model: Model

    def to_dict(self) -> dict[str, Any]:
        """Returns the content of ``train.json``."""
        values = self.policy.parameters.tolist()
        return {
            "iterations": self.iterations,
            "policy": dict(zip(self.policy.names, values, strict=True)),
            "deployed": self.deployed,
            "internal_model": self.domain,
        }


@dataclass(frozen=True)
class Tried:
    """A policy that ran on the target, its internal model, and its return there."""

    policy: Policy
    domain: dict[str, float]
    real_return: float


def best_measured(
    tried: Sequence[Tried], deploys: Literal["best measured", "last"], threshold: float | None
) -> int | None:
    """Returns the iteration of the policy to deploy, ``None`` for the last policy.

    Args:
        tried: Policies with their measured returns, by iteration.
        deploys: The loop's option.
        threshold: Return above which an episode is a success. If no policy reached it, the last
            policy, which has not been tried, is more promising.
    """
    if deploys == "last" or not tried:
        return None
    best = max(range(len(tried)), key=lambda index: tried[index].real_return)
    if threshold is not None and tried[best].real_return < threshold:
        return None
    return best
