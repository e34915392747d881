"""A task on a device: the policy's form, the reward and the initial states of episodes."""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches

import torch
from torch import Tensor

from npdr_ppl.engines.common.episodes import Reward
from npdr_ppl.errors import ModelError
from npdr_ppl.policies.base import Policy

__all__ = ["ControlTask", "control_task", "control_tasks"]


@dataclass(frozen=True)
class ControlTask:
    """A task for a policy.

    Attributes:
        name: Name that selects it.
        policy: The policy with the initial parameters of a policy search.
        reward: Reward of a step.
        initial_states: Draws n true states at the start of an episode, ``(n, states)``.
        num_steps: Steps of an episode.
        success: Return above which an episode is a success; ``None`` if there is none.
        excitation: Policy that runs the device if the data do not determine the parameters;
            ``None`` for the current policy.
    """

    name: str
    policy: Policy
    reward: Reward
    initial_states: Callable[[int, torch.Generator], Tensor]
    num_steps: int
    success: float | None = None
    excitation: Policy | None = None


def _furuta_swing_up() -> ControlTask:
    from npdr_ppl.models.furuta import SwingUpReward, initial_states
    from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp

    # In the paper, a policy with a return above about 1400 is a success. The excitation is the
    # untrained policy, because it swings for whole episodes; a policy trained on a wide prior
    # drives the arm against its stop.
    return ControlTask(
        "furuta-swing-up",
        FurutaSwingUp(),
        SwingUpReward(),
        initial_states,
        2_500,
        1_400.0,
        FurutaSwingUp(),
    )


_TASKS: dict[str, Callable[[], ControlTask]] = {"furuta-swing-up": _furuta_swing_up}


def control_tasks() -> tuple[str, ...]:
    """Returns the names of the tasks in the model zoo."""
    return tuple(_TASKS)


def control_task(name: str) -> ControlTask:
    """Returns a task of the model zoo.

    Raises:
        ModelError: There is no such task.
    """
    if name not in _TASKS:
        close = get_close_matches(name, _TASKS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(_TASKS)}."
        raise ModelError(f"There is no task {name!r}; {hint}")
    return _TASKS[name]()
