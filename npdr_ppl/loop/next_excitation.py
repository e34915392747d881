"""Excitations for a device whose data do not determine the parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from npdr_ppl.discovery.proof.next_experiment import excitation_commands
from npdr_ppl.language.channels import Channel
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import domains_at
from npdr_ppl.policies.base import Policy
from npdr_ppl.policies.playback import Playback
from npdr_ppl.posterior.posterior import Posterior

__all__ = ["chosen_excitation", "proposed_excitation"]

NUM_TRIED = 20
"""Number of posterior draws in which a proposed excitation is simulated: enough for a median."""

LEAST_LASTING = 0.5
"""Smallest share of a proposed excitation that the simulated episode must last in most draws. An
excitation that drives the device against a stop at once tells little, and may damage it."""


def proposed_excitation(
    experiment: Mapping[str, Any] | None, actions: Sequence[Channel], time_step: float
) -> Playback | None:
    """Returns the commands of the experiment that discovery proposes, ``None`` if there is none.

    Args:
        experiment: ``next_experiment`` in ``discovery.json``.
        actions: The device's actions.
        time_step: Seconds per command.
    """
    if not experiment or experiment["excitation"] is None:
        return None
    shape = excitation_commands(time_step)[experiment["excitation"]]
    names = tuple(action.name for action in actions)
    amplitudes = np.array([experiment["amplitude"].get(name, 0.0) for name in names])
    # The last command is held after the end, so a zero command is appended.
    commands = np.concatenate((np.outer(shape, amplitudes), np.zeros((1, len(names)))))
    return Playback(torch.tensor(commands, dtype=torch.float32), names, time_step)


def chosen_excitation(
    task: ControlTask,
    policy: Policy,
    proposal: Playback | None,
    posterior: Posterior | None,
    *,
    seed: int,
) -> Policy:
    """Returns the excitation for another rollout.

    The first choice is the experiment that discovery proposes, because it separates the possible
    causes. If there is none, or the device would not run through it, the task's excitation is
    used, and if the task has none, the current policy.

    Args:
        task: Its excitation is the usual choice.
        policy: The current policy.
        proposal: The experiment that discovery proposes.
        posterior: The posterior in which the proposal is simulated; if it is ``None``, because
            nothing has been inferred, the proposal is not used.
        seed: Seed of the draws and initial states.
    """
    if proposal is not None and posterior is not None and _lasts(task, proposal, posterior, seed):
        return proposal
    return task.excitation or policy


def _lasts(task: ControlTask, proposal: Playback, posterior: Posterior, seed: int) -> bool:
    """Returns whether the device runs through the proposal in most draws of the posterior."""
    num_steps = min(len(proposal.commands) - 1, task.num_steps)
    generator = torch.Generator().manual_seed(seed)
    domains = domains_at(posterior.prior, posterior.sample_mixture(NUM_TRIED, seed=seed))
    parameters = {name: value.float() for name, value in domains.parameters.items()}
    starts = task.initial_states(1, generator).float()[0]
    episodes = domains.simulator.roll_out(parameters, proposal, starts, num_steps)
    return float(episodes.lengths.double().median()) >= LEAST_LASTING * num_steps
