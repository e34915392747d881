"""The NPDR loop's actions after a diagnosis, and their records."""

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
"""Key of decisions that a check of the new policy in simulation caused."""


@dataclass(frozen=True)
class Settled:
    """A posterior, and the action that followed from it."""

    posterior: Posterior
    data: "Data"
    action: Action


def action_for(
    decision: Decision, options: LoopOptions, *, may_revise: bool, real_return: float
) -> Action:
    """Returns the loop's action after a decision.

    Args:
        decision: The decision of the diagnosis.
        options: Options of the loop.
        may_revise: Whether a search for missing effects is possible; it may find none.
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
    excitation: Mapping[str, Any] | None = None,
    is_from_check: bool = False,
) -> dict[str, Any]:
    """Returns a decision in the form of ``train.json``.

    Args:
        decision: The decision.
        reason: Its reason, in a sentence.
        action: The loop's action after it.
        diagnosis: The figures; decisions of discovery or of a check have none.
        excitation: The excitation of the rollout that was recorded, in the form of ``train.json``.
        is_from_check: Whether a check of the new policy in simulation asked for it.
    """
    recorded = {} if excitation is None else {"excitation": dict(excitation)}
    origin = {FROM_CHECK: True} if is_from_check else {}
    return {
        "decision": decision.value,
        "reason": reason,
        "action": action.value,
        "diagnosis": dict(diagnosis or {}),
        **recorded,
        **origin,
    }


def enough(real_return: float) -> str:
    """Returns the sentence that gives the reached return as the reason to end the loop."""
    return f"The return on the target, {real_return:.0f}, reaches the requested return."


def kept_record(
    real_return: float, num_rollouts: int, effects: list[str], internal_model: Mapping[str, float]
) -> dict[str, Any]:
    """Returns the record of an iteration whose measured return ends the loop by itself.

    Args:
        real_return: The iteration's mean return on the target.
        num_rollouts: Number of real rollouts so far.
        effects: Names of the effects that were added to the model.
        internal_model: Parameters of the policy's internal model.
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
    """Returns the number of decisions that led to one of these actions."""
    return sum(decision["action"] in actions for decision in decisions)


def count_checks(decisions: Sequence[Mapping[str, Any]]) -> int:
    """Returns how many rollouts the checks before deploying asked for.

    After each of them, inference and training are repeated.
    """
    return sum(FROM_CHECK in decision for decision in decisions)


def is_final(record: Mapping[str, Any]) -> bool:
    """Returns whether the loop ends after this iteration."""
    return record["decisions"][-1]["action"] == Action.KEPT
