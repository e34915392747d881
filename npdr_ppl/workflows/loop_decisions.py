"""What the NPDR loop does about a diagnosis, and how it notes that down."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from npdr_ppl.workflows.diagnostics import Decision
from npdr_ppl.workflows.loop_options import Action, LoopOptions
from npdr_ppl.workflows.posterior import Posterior

if TYPE_CHECKING:
    from npdr_ppl.workflows.arviz_module import Data

__all__ = ["Settled", "action_for", "decision_record", "is_final"]


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
        Decision.WIDEN: Action.MIXED,
        Decision.STOP: Action.KEPT,
    }[decision]


def decision_record(
    decision: Decision, reason: str, action: Action, diagnosis: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Returns a decision as ``train.json`` has it; what discovery asks for has no diagnosis."""
    return {
        "decision": decision.value,
        "reason": reason,
        "action": action.value,
        "diagnosis": dict(diagnosis or {}),
    }


def is_final(record: Mapping[str, Any]) -> bool:
    """Returns whether the loop ends with an iteration."""
    return record["decisions"][-1]["action"] == Action.KEPT
