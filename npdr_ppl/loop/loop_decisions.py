"""What the NPDR loop does about a diagnosis, and how it notes that down."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from npdr_ppl.loop.loop_options import Action, LoopOptions
from npdr_ppl.posterior.diagnostics import Decision
from npdr_ppl.posterior.posterior import Posterior

if TYPE_CHECKING:
    from npdr_ppl.arviz_module import Data

__all__ = [
    "Settled",
    "action_for",
    "count_actions",
    "count_checks",
    "decision_record",
    "enough",
    "is_final",
    "kept_record",
]

FROM_CHECK = "from_check"
"""Key of decisions that a check of the new policy in simulation led to."""


@dataclass(frozen=True)
class Settled:
    """A posterior, and what was decided about it."""

    posterior: Posterior
    data: "Data"
    decisions: list[dict[str, Any]]
    action: Action


def action_for(
    decision: Decision, options: LoopOptions, *, may_revise: bool, real_return: float
) -> Action:
    """Returns what the loop does about a decision.

    Args:
        decision: What the diagnosis came to.
        options: Options of the loop.
        may_revise: Whether a missing effect can be looked for; it may turn out that there is none.
        real_return: The iteration's mean return on the target.
    """
    if not options.follows_decisions:
        return Action.LOGGED
    if decision is Decision.REVISE_MODEL:
        return Action.REVISED if may_revise else Action.SPREAD
    if decision is Decision.ACCEPT:
        wanted = options.stop_return
        return Action.KEPT if wanted is not None and real_return >= wanted else Action.TRAINED
    return {
        Decision.MORE_ROUNDS: Action.MORE_ROUNDS,
        Decision.NEW_ROLLOUT: Action.ANOTHER_ROLLOUT,
        Decision.OTHER_EXCITATION: Action.ANOTHER_ROLLOUT,
        Decision.WIDEN: Action.MIXED,
        Decision.STOP: Action.KEPT,
    }[decision]


def decision_record(
    decision: Decision,
    reason: str,
    action: Action,
    diagnosis: Mapping[str, Any] | None = None,
    *,
    is_from_check: bool = False,
) -> dict[str, Any]:
    """Returns a decision as ``train.json`` has it.

    Args:
        decision: What is to be done.
        reason: Why, in a sentence.
        action: What the loop did about it.
        diagnosis: The figures; what discovery or a check asks for has none.
        is_from_check: Whether a check of the new policy in simulation asked for it.
    """
    origin = {FROM_CHECK: True} if is_from_check else {}
    return {
        "decision": decision.value,
        "reason": reason,
        "action": action.value,
        "diagnosis": dict(diagnosis or {}),
        **origin,
    }


def enough(real_return: float) -> str:
    """Returns the reason to end the loop at a return on the target."""
    return f"The return on the target, {real_return:.0f}, is what was asked for."


def kept_record(
    real_return: float, num_rollouts: int, effects: list[str], internal_model: Mapping[str, float]
) -> dict[str, Any]:
    """Returns the record of an iteration whose measured return ends the loop by itself.

    Args:
        real_return: The iteration's mean return on the target.
        num_rollouts: Real rollouts so far.
        effects: Names of the effects that the model has been given.
        internal_model: Parameters of the policy's own model.
    """
    decision = decision_record(Decision.STOP, enough(real_return), Action.KEPT)
    return {
        "decision": decision["decision"],
        "reason": decision["reason"],
        "num_rollouts": num_rollouts,
        "decisions": [decision],
        "effects": effects,
        "internal_model": dict(internal_model),
        "parameters": {},  # nothing was inferred
        "checks": [],
    }


def count_actions(decisions: Sequence[Mapping[str, Any]], *actions: Action) -> int:
    """Returns how many decisions led to one of these actions."""
    return sum(decision["action"] in actions for decision in decisions)


def count_checks(decisions: Sequence[Mapping[str, Any]]) -> int:
    """Returns how many rollouts checks before deploying asked for: how often all began anew."""
    return sum(FROM_CHECK in decision for decision in decisions)


def is_final(record: Mapping[str, Any]) -> bool:
    """Returns whether the loop ends with an iteration."""
    return record["decisions"][-1]["action"] == Action.KEPT
