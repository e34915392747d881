"""Rollouts of a policy on the target domain: each is saved before it is used."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.errors import DataError
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.journal import Journal, read_journal
from npdr_ppl.policies.base import Policy
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import Array, Controller, TargetDomain, partial_rollout

__all__ = ["RealRollouts", "rewards_of"]


class RealRollouts:
    """Runs policies on a target and keeps every rollout.

    Args:
        target: The target domain.
        task: The task of the policy. Its reward is used, so that returns on the target and in
            simulation can be compared. The target's own rewards are used if its episodes were
            recorded earlier, or if the state is not recorded.
        simulator: Names the state's components, for the reward.
        folder: Folder for the rollouts; ``None`` keeps them in memory only.

    Raises:
        DataError: The target lacks a channel that the policy reads or commands.
    """

    def __init__(
        self,
        target: TargetDomain,
        task: ControlTask,
        simulator: ClosedLoopSimulator,
        folder: Path | None = None,
    ) -> None:
        self.target = target
        self.task = task
        self.simulator = simulator
        self.folder = folder
        sensors = [sensor.name for sensor in target.sensors]
        actions = [action.name for action in target.actions]
        policy = task.policy
        needed = [*policy.observations, *policy.actions]
        if target.is_recorded:  # no policy runs, but rewards are computed
            needed = [state.name for state in simulator.states]
            needed += [action.name for action in simulator.actions]
        missing = [name for name in needed if name not in sensors + actions]
        if missing:
            raise DataError(f"{target.name} has no channel {', '.join(missing)}.")

    def collect(
        self, episode: int, policy: Policy, domain: Mapping[str, float], *, seed: int
    ) -> Rollouts:
        """Returns the rollout of an episode, from disk if it was recorded already.

        Args:
            episode: Number of the episode in the whole run, from 0.
            policy: The policy to run.
            domain: Parameters of the policy's internal model.
            seed: Seed of the episode.

        Raises:
            DataError: The rollout has no whole step.
        """
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        file = None if self.folder is None else self.folder / f"rollout_{episode:03d}.nc"
        if file is not None and file.exists():
            return Rollouts.from_netcdf(file)
        journal_file = None if file is None else file.with_suffix(".jsonl")
        recovered = None if journal_file is None else self._recover(journal_file)
        if recovered is not None:
            rollout, commands = recovered
        else:
            rollout, commands = self._run(episode, policy, domain, seed, journal_file)
        keeps_own = self.target.is_recorded or missing_states(self.simulator, rollout)
        if rollout.rewards is None or not keeps_own:
            rollout = self._with_rewards(rollout, commands)
        if file is not None:
            rollout.to_netcdf(file)
        return rollout

    def _run(
        self,
        episode: int,
        policy: Policy,
        domain: Mapping[str, float],
        seed: int,
        journal_file: Path | None,
    ) -> tuple[Rollouts, Array]:
        journal = Journal(self._controller(policy, domain), journal_file)
        try:
            rollout = self.target.run(journal, self.task.num_steps, episode=episode, seed=seed)
            journal.end(rollout.readings[0][-1])
        except BaseException as error:
            partial = partial_rollout(error)
            if partial is not None and journal_file is not None:
                partial.to_netcdf(journal_file.with_suffix(".partial.nc"))
            raise
        finally:
            journal.close()
        if not len(rollout.actions[0]):
            raise DataError(f"{self.target.name} ended episode {episode} before its first step.")
        return rollout, np.array(journal.commands)

    def _recover(self, journal_file: Path) -> tuple[Rollouts, Array] | None:
        """Returns an episode that was complete when the process was killed.

        The file of an incomplete episode is renamed, so that its measurements are not lost.
        """
        if not journal_file.exists():
            return None
        rollout, commands, is_complete = read_journal(journal_file, self.target)
        if rollout is not None and is_complete:
            return rollout, commands
        aside = len(list(journal_file.parent.glob(f"{journal_file.stem}.interrupted_*.jsonl")))
        journal_file.rename(
            journal_file.with_name(f"{journal_file.stem}.interrupted_{aside}.jsonl")
        )
        return None

    def _controller(self, policy: Policy, domain: Mapping[str, float]) -> Controller:
        """Returns the policy as a function of all measurements of the target."""
        sensors = [sensor.name for sensor in self.target.sensors]
        if self.target.is_recorded:
            return lambda readings, time: np.zeros(len(self.target.actions))
        columns = [sensors.index(name) for name in policy.observations]
        order = [policy.actions.index(action.name) for action in self.target.actions]
        command = policy.controller({k: torch.as_tensor(v) for k, v in domain.items()})

        def controller(readings: Array, time: float) -> Array:
            return command(readings[columns], time)[order]

        return controller

    def _with_rewards(self, rollout: Rollouts, commands: Array) -> Rollouts:
        # For an episode recorded earlier, only the applied commands are known.
        issued = commands if len(commands) else rollout.actions[0]
        rewards = rewards_of(self.task, self.simulator, rollout, issued)
        return replace(rollout, rewards=(rewards,))


def rewards_of(
    task: ControlTask, simulator: ClosedLoopSimulator, rollout: Rollouts, commands: Array
) -> NDArray[np.float64]:
    """Returns the reward of every step, ``(T,)``, computed from measurements as on a device.

    Args:
        task: Gives the reward.
        simulator: Names the state's components.
        rollout: One rollout.
        commands: Commands before any limit, ``(T, actions)``.

    Raises:
        DataError: A component of the state was not recorded.
    """
    columns = {name: i for i, name in enumerate(rollout.channel_names)}
    missing = missing_states(simulator, rollout)
    if missing:
        raise DataError(f"The reward needs measurements of {', '.join(missing)}.")
    readings = torch.tensor(rollout.readings[0][:-1])
    state = [readings[:, columns[component.name]] for component in simulator.states]
    half = len(state) // 2
    rewards = task.reward(
        tuple(state[:half]),
        tuple(state[half:]),
        tuple(torch.tensor(commands[: len(readings)]).unbind(-1)),
    )
    return rewards.numpy()


def missing_states(simulator: ClosedLoopSimulator, rollout: Rollouts) -> list[str]:
    """Returns the components of the state that were not recorded."""
    return [state.name for state in simulator.states if state.name not in rollout.channel_names]
