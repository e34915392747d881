"""What a device is run with where its data say too little."""

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
"""Draws of the posterior in which a proposed excitation is tried: enough for a median."""

LEAST_LASTING = 0.5
"""Share of a proposed excitation that the device must last in most draws: one that drives it
against a stop at once tells little, and may break it."""


def proposed_excitation(
    experiment: Mapping[str, Any] | None, actions: Sequence[Channel], time_step: float
) -> Playback | None:
    """Returns the commands of the experiment that discovery proposes, ``None`` if there is none.

    Args:
        experiment: ``next_experiment`` as ``discovery.json`` has it.
        actions: The device's actions.
        time_step: Seconds per command.
    """
    if not experiment or experiment["excitation"] is None:
        return None
    shape = excitation_commands(time_step)[experiment["excitation"]]
    names = tuple(action.name for action in actions)
    amplitudes = np.array([experiment["amplitude"].get(name, 0.0) for name in names])
    # Afterwards nothing is commanded; the last command would be held.
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
    """Returns what to record another rollout with.

    The experiment that discovery proposes, because it separates what is doubtful; the task's
    excitation where there is no such experiment, or the device would not last through it; the
    present policy where the task has none.

    Args:
        task: Its excitation is the usual choice.
        policy: The present policy.
        proposal: What discovery proposes.
        posterior: The posterior that it is tried in; ``None`` before there is one, in which case
            the proposal is not taken.
        seed: Seed of the draws and initial states.
    """
    if proposal is not None and posterior is not None and _lasts(task, proposal, posterior, seed):
        return proposal
    return task.excitation or policy


def _lasts(task: ControlTask, proposal: Playback, posterior: Posterior, seed: int) -> bool:
    """Returns whether the device lasts in most draws of the posterior."""
    num_steps = min(len(proposal.commands) - 1, task.num_steps)
    generator = torch.Generator().manual_seed(seed)
    domains = domains_at(posterior.prior, posterior.sample_mixture(NUM_TRIED, seed=seed))
    parameters = {name: value.float() for name, value in domains.parameters.items()}
    starts = task.initial_states(1, generator).float()[0]
    episodes = domains.simulator.roll_out(parameters, proposal, starts, num_steps)
    return float(episodes.lengths.double().median()) >= LEAST_LASTING * num_steps
