"""Excitations for a device whose data do not determine the parameters.

If discovery found effects that it cannot tell apart, the experiment that it proposes comes first.
Otherwise the excitation is chosen that is expected to tell most about the parameters: each one is
simulated at the most likely parameters, and the simulated recording gets the likelihood that the
real one would get. With its Fisher information J and the posterior's covariance Σ, the expected
gain of information is ½ log det(1 + Σ J) in nats (Bayesian D-optimality; Chaloner & Verdinelli
1995).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from npdr_ppl.discovery.proof.next_experiment import excitation_commands
from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.engines.common.episodes import Episodes
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.channels import Channel
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import domains_at
from npdr_ppl.policies.base import Policy
from npdr_ppl.policies.playback import Playback
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.posterior.prepare import Preparation, held_out
from npdr_ppl.rollouts import Rollouts

__all__ = ["ChosenExcitation", "chosen_excitation", "proposed_excitation"]

NUM_TRIED = 20
"""Number of posterior draws in which an excitation is simulated: enough for a median."""

NUM_COVARIANCE_DRAWS = 1_000
"""Number of posterior draws for the covariance of the parameters."""

LEAST_LASTING = 0.5
"""Smallest share of an excitation that the simulated episode must last in most draws. An
excitation that drives the device against a stop at once tells little, and may damage it."""

PROPOSED, OF_TASK, CURRENT = "discovery's proposal", "the task's excitation", "the current policy"


@dataclass(frozen=True)
class ChosenExcitation:
    """The excitation for another rollout.

    Attributes:
        name: What it is: discovery's proposal, the task's excitation, the current policy, or a
            shape of :func:`~npdr_ppl.discovery.proof.next_experiment.excitation_commands`.
        policy: The policy that runs it.
        information: Expected gain of information in nats, by excitation; NaN if the device would
            not last through it. Empty if the excitations were not compared.
    """

    name: str
    policy: Policy
    information: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values; information that is not finite is null."""
        finite = {k: v if math.isfinite(v) else None for k, v in self.information.items()}
        return {"name": self.name, "information": finite}


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
    return _playback(experiment["excitation"], experiment["amplitude"], actions, time_step)


def chosen_excitation(
    task: ControlTask,
    policy: Policy,
    proposal: Playback | None,
    posterior: Posterior | None,
    internal_model: Mapping[str, float],
    *,
    seed: int,
    compares: bool = True,
) -> ChosenExcitation:
    """Returns the excitation for another rollout.

    Args:
        task: Its excitation is one of those compared, and the usual choice where nothing can be
            compared.
        policy: The current policy, which is used if the task has no excitation.
        proposal: The experiment that discovery proposes.
        posterior: The posterior in which excitations are simulated; ``None`` if nothing has been
            inferred.
        internal_model: Parameters of the policies' internal model on the target.
        seed: Seed of the draws and initial states.
        compares: Whether excitations are compared; otherwise the task's is used.
    """
    usual = (
        ChosenExcitation(CURRENT, policy)
        if task.excitation is None
        else ChosenExcitation(OF_TASK, task.excitation)
    )
    if posterior is None:
        return usual
    trial = _Trial(task, posterior, internal_model, seed)
    if proposal is not None and trial.episodes(proposal) is not None:
        return ChosenExcitation(PROPOSED, proposal)
    prepared = posterior.preparation
    if not compares or prepared is None or prepared.likelihood is None:
        return usual
    candidates = {usual.name: usual.policy, CURRENT: policy, **_shapes(prepared.rollouts, trial)}
    information = {
        name: trial.information(candidate, prepared) for name, candidate in candidates.items()
    }
    known = {name: value for name, value in information.items() if math.isfinite(value)}
    best = max(known, key=lambda name: known[name]) if known else usual.name
    return ChosenExcitation(best, candidates[best], information)


class _Trial:
    """Simulates excitations in draws of a posterior, the first of which is the most likely one."""

    def __init__(
        self,
        task: ControlTask,
        posterior: Posterior,
        internal_model: Mapping[str, float],
        seed: int,
    ) -> None:
        self.task = task
        self.internal_model = internal_model
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        self.start = task.initial_states(1, generator).float()[0]
        prior = posterior.prior
        most_likely = posterior.most_likely(seed=seed)
        first = prior.to_reference({k: v[None] for k, v in most_likely.items()})
        draws = posterior.sample_mixture(NUM_TRIED, seed=seed)
        self.domains = domains_at(prior, torch.cat((first.to(draws), draws)))
        draws = posterior.sample_mixture(NUM_COVARIANCE_DRAWS, seed=seed).double()
        self.covariance = torch.cov(draws.T).reshape(draws.shape[1], -1)

    def episodes(self, policy: Policy) -> Episodes | None:
        """Returns the recorded episodes of an excitation in all draws.

        ``None`` if the simulator cannot run it, or the device would not last through it in most
        draws.
        """
        try:
            found = self.domains.simulator.roll_out(
                {name: value.float() for name, value in self.domains.parameters.items()},
                policy,
                self.start,
                self.task.num_steps,
                record=True,
                internal_model=self.internal_model,
            )
        except NpdrError:
            return None
        num_steps = self.task.num_steps
        if isinstance(policy, Playback):
            num_steps = min(len(policy.commands) - 1, num_steps)
        lasts = float(found.lengths.double().median()) >= LEAST_LASTING * num_steps
        return found if lasts else None

    def information(self, policy: Policy, prepared: Preparation) -> float:
        """Returns the information gained by an excitation in nats; NaN if it is not known."""
        episodes = self.episodes(policy)
        if episodes is None:
            return math.nan
        try:
            likelihood = held_out(prepared, self._recording(episodes, prepared))
        except NpdrError:
            return math.nan
        if likelihood is None:
            return math.nan
        gained = torch.eye(len(self.covariance)) + self.covariance @ likelihood.information()
        return 0.5 * float(torch.linalg.slogdet(gained).logabsdet)

    def _recording(self, episodes: Episodes, prepared: Preparation) -> Rollouts:
        """Returns the recording at the most likely draw, with the noise that was found.

        Without noise, initial states would be estimated better than on the device.
        """
        assert episodes.readings is not None
        assert episodes.commands is not None
        assert prepared.likelihood is not None
        simulator = self.domains.simulator
        sensors = [sensor.name for sensor in simulator.sensors]
        length = int(episodes.lengths[0])
        commands = episodes.commands[0, :length].double().numpy()
        lower = [action.lower for action in simulator.actions]
        upper = [action.upper for action in simulator.actions]
        likelihood = prepared.likelihood
        names = likelihood.segments.channel_names
        scale = likelihood.fit.scale * math.sqrt(likelihood.variance)
        readings = episodes.readings[0, : length + 1, [sensors.index(name) for name in names]]
        generator = torch.Generator().manual_seed(self.seed)
        noise = torch.randn(readings.shape, generator=generator, dtype=torch.float64)
        return Rollouts.from_arrays(
            (readings.double() + scale * noise).numpy()[None],
            np.clip(commands, lower, upper)[None],
            channel_names=names,
            action_names=[action.name for action in simulator.actions],
            time_step=prepared.rollouts.time_step,
        )


def _shapes(rollouts: Rollouts, trial: _Trial) -> dict[str, Policy]:
    """Returns excitations whose commands are within those that the device has had."""
    least = np.min([actions.min(0) for actions in rollouts.actions], axis=0)
    most = np.max([actions.max(0) for actions in rollouts.actions], axis=0)
    reach, centre = EXPERIMENT.safe_share * 0.5 * (most - least), 0.5 * (most + least)
    names = rollouts.action_names
    amplitude = dict(zip(names, reach.tolist(), strict=True))
    middle = dict(zip(names, centre.tolist(), strict=True))
    actions, step = trial.domains.simulator.actions, rollouts.time_step
    return {
        name: _playback(name, amplitude, actions, step, middle)
        for name in excitation_commands(step)
    }


def _playback(
    name: str,
    amplitude: Mapping[str, float],
    actions: Sequence[Channel],
    time_step: float,
    middle: Mapping[str, float] | None = None,
) -> Playback:
    """Returns an excitation as commands around a middle value, followed by zero commands."""
    shape = excitation_commands(time_step)[name]
    names = tuple(action.name for action in actions)
    amplitudes = np.array([amplitude.get(action, 0.0) for action in names])
    around = np.array([(middle or {}).get(action, 0.0) for action in names])
    # The last command is held after the end, so a zero command is appended.
    commands = np.concatenate((around + np.outer(shape, amplitudes), np.zeros((1, len(names)))))
    return Playback(torch.tensor(commands, dtype=torch.float32), names, time_step)
