"""The NPDR loop, Algorithm 1 of Muratore et al. (2021), driven by diagnostics.

An iteration runs the policy on the target domain and infers the domain parameters from the
rollouts. The diagnosis of this posterior decides the next step. Then the policy is trained in
domains drawn from the posterior::

    policy ← POLOPT(prior)
    repeat
        rollouts ← run the policy on the target, with the most likely sample as internal model
        model ← discover(model, rollouts), if the options ask for it
        posterior ← INFER(model, rollouts), in rounds
        decision ← diagnose(posterior): accept, more rounds, another rollout, revise the model,
                   widen, stop
        policy ← POLOPT(posterior)
        check the policy over the posterior: if it fails too often, record another rollout and
            return to INFER, or train it for the worst domains

If a folder is given, every rollout, round and policy is saved before the next step. A run that was
killed then continues and reaches the same result; see :mod:`npdr_ppl.loop.loop_folder`.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import (
    Domains,
    domains_at,
    most_likely_domain,
    simulator_of,
)
from npdr_ppl.loop.loop_decisions import (
    Settled,
    action_for,
    count_actions,
    count_checks,
    decision_record,
    enough,
    is_final,
    kept_record,
)
from npdr_ppl.loop.loop_discovery import LoopDiscovery, effect_names
from npdr_ppl.loop.loop_folder import LoopFolder
from npdr_ppl.loop.loop_inference import infer_posterior
from npdr_ppl.loop.loop_model import LoopModel
from npdr_ppl.loop.loop_options import (
    LOOP_DATA,
    NEW_ATTEMPTS,
    Action,
    LoopOptions,
    Model,
    Revise,
)
from npdr_ppl.loop.loop_result import Training, Tried, best_measured
from npdr_ppl.loop.next_excitation import chosen_excitation
from npdr_ppl.loop.policy_optimisation import optimise_policy
from npdr_ppl.loop.policy_training import LoopTraining
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.loop.risk import Risk
from npdr_ppl.loop.rollout_budget import LoopRollouts
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.posterior.diagnostics import Decision, diagnose
from npdr_ppl.posterior.fit import describe
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.preparation.data_options import DataOptions, checked_options
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.randomness import derived_seed, seeded
from npdr_ppl.run_files import claimed, plain
from npdr_ppl.targets.base import TargetDomain

__all__ = ["Training", "train"]

_LOGGER = logging.getLogger(__name__)

PREDICTIVE_DRAWS = 500
"""Number of posterior draws per ensemble member that a diagnosis uses."""

LEAST_SHARE = 0.5
"""Share of an episode's steps that discovery needs. If a rollout ended early and an effect is
visible in few segments, it can be distinguished from chance, but not from other effects."""


def train(
    model: Model,
    target: TargetDomain,
    task: ControlTask,
    *,
    options: DataOptions | None = None,
    loop: LoopOptions | None = None,
    out: str | PathLike[str] | None = None,
    revise: Revise | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> Training:
    """Trains a policy for a target domain that differs from the simulator.

    Args:
        model: A Pyro model of the target with one black-box site.
        target: The target domain; its parameters stay unknown.
        task: The task of the policy.
        options: How rollouts are prepared for inference and discovery; ``LOOP_DATA`` if ``None``.
            Discovery always estimates initial states and noise, and never takes whole rollouts.
        loop: Options of the loop.
        out: Folder for the run and its ``train.json``. If a run was killed there, it continues.
        revise: Function that searches for a missing effect if a diagnosis asks for it.
        seed: Seed of all random numbers.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Raises:
        DataError: The target's channels do not match, or the folder contains another run.
        ModelError: Policies cannot be trained on the model; see
            :func:`npdr_ppl.loop.domains.simulator_of`.
    """
    options, loop = checked_options(options, LOOP_DATA), loop or LoopOptions()
    with reporter(progress) as report, ExitStack() as stack:
        path = out or stack.enter_context(TemporaryDirectory(prefix="npdr-"))
        folder = LoopFolder(Path(path))
        run = _Loop(model, target, task, options, loop, folder, revise, seed, report)
        # Made after the checks, so that a model or target that does not match leaves no folder.
        stack.enter_context(claimed(folder.path))
        folder.begin(model, target, task, options, loop, seed=seed)
        return run.run()


class _Loop:
    """The state of one run."""

    def __init__(
        self,
        model: Model,
        target: TargetDomain,
        task: ControlTask,
        options: DataOptions,
        loop: LoopOptions,
        folder: LoopFolder,
        revise: Revise | None,
        seed: int,
        report: Reporter,
    ) -> None:
        self.target = target
        self.task = task
        self.options = options
        self.loop = loop
        self.folder = folder
        # A function given by the caller replaces discovery.
        may_discover = loop.follows_decisions and revise is None
        self.discovers = loop.discovers if may_discover else "never"
        discovery = LoopDiscovery(
            model,
            options,
            loop.discovery,
            seed=derived_seed(seed, "discovery in the loop"),
        )
        self.model = LoopModel(model, target, discovery, revise)
        self.seed = seed
        self.report = report
        search, backend = loop.search, loop.backend
        self.search = policy_search(search) if isinstance(search, str) else search
        self.backend = backend_by_name(backend) if isinstance(backend, str) else backend
        simulator = simulator_of(self.model.prior)
        self.domain = {name: float(value) for name, value in simulator.nominal().items()}
        real = RealRollouts(target, task, simulator, folder.rollouts)
        self.rollouts = LoopRollouts(real, loop, seed)
        self.training = LoopTraining(
            task, loop, folder, seed, from_prior=lambda number: self._prior_domains(number)
        )
        self.policy = task.policy
        self.posterior: Posterior | None = None
        self.records: list[dict[str, Any]] = []
        self.tried: list[Tried] = []

    def run(self) -> Training:
        """Runs all iterations that are not finished yet."""
        if not self.rollouts.can_collect(self.loop.rollouts):
            raise DataError(
                f"{self.target.name} has {self.target.num_episodes} episodes; an iteration takes "
                f"{self.loop.rollouts}."
            )
        if self.loop.starts_from_prior:
            saved = self.folder.policy(0)
            if saved is None:
                domains = self._prior_domains(self.loop.num_domains)
                saved = self._optimise(self.report, domains, self._start, self.loop.risk, (0,))
                self.folder.save_policy(0, *saved)
            self._use(saved[0])
        for index in range(self.loop.iterations):
            report = self.report.under(f"iteration {index + 1}/{self.loop.iterations}")
            if not self.rollouts.can_collect(self.loop.rollouts):
                _LOGGER.warning(
                    "All %d episodes of %s have been used, after %d of %d iterations.",
                    self.target.num_episodes, self.target.name, index, self.loop.iterations,
                )  # fmt: skip
                break
            self.records.append(self._iterate(index, report))
            self.folder.write_result(self._result().to_dict())
            if is_final(self.records[-1]):
                break
        return self._result()

    def _result(self) -> Training:
        best = best_measured(self.tried, self.loop.deploys, self.task.success)
        return Training(
            self.policy if best is None else self.tried[best].policy,
            self.domain if best is None else self.tried[best].domain,
            best,
            list(self.records),
            self.rollouts.joined(),
            self.posterior,
            self.model.model,
        )

    def _iterate(self, index: int, report: Reporter) -> dict[str, Any]:
        """Runs one iteration, or restores it if an earlier process finished it."""
        returns = self._real_returns(index)
        real_return = sum(returns) / len(returns)
        self.tried.append(Tried(self.policy, self.domain, real_return))
        saved = self.folder.iteration(index)
        if saved is not None:
            self._take_over(index, saved, report)
            return saved
        record: dict[str, Any] = {"real_return": real_return, "real_returns": returns}
        if self._is_good_enough(real_return):
            record |= kept_record(
                real_return, len(self.rollouts), effect_names(self.model.model), self.domain
            )
        else:
            record |= self._improved(index, real_return, report)
        record = plain(record)
        self.folder.save_iteration(index, record)
        return record

    def _real_returns(self, index: int) -> list[float]:
        """Runs the policy on the target; returns its return in each episode.

        While the mean return would end the loop by itself, extra rollouts confirm it.
        """
        loop = self.loop
        returns: list[float] = []
        while len(returns) < loop.rollouts or (
            len(returns) < loop.rollouts + loop.num_confirmations
            and self._is_good_enough(sum(returns) / len(returns))
            and self.rollouts.extra_left(index)
        ):
            rollout = self.rollouts.collect(self.policy, self.domain)
            returns += [float(rewards.sum()) for rewards in rollout.rewards or ()]
        return returns

    def _is_good_enough(self, real_return: float) -> bool:
        """Returns whether the measured return is enough to end the loop."""
        loop = self.loop
        wanted = loop.stop_return if loop.stops == "measured return" else None
        return loop.follows_decisions and wanted is not None and real_return >= wanted

    def _improved(self, index: int, real_return: float, report: Reporter) -> dict[str, Any]:
        """Infers the posterior, trains the next policy, and returns the iteration's record."""
        decisions: list[dict[str, Any]] = []
        checks: list[dict[str, Any]] = []
        trained: dict[str, Any] | None = None
        while True:
            settled = self._infer_and_decide(index, real_return, decisions, report)
            is_last = is_final({"decisions": decisions})
            if self.loop.internal_model == "most likely" and not is_last:
                self.domain = most_likely_domain(settled.posterior, seed=self.seed)
            trained = None if is_last else self._train(index, settled, checks, report)
            if is_last or trained is not None:
                break
            excitation = self._collect_excitation(settled.posterior)
            reason = checks[-1]["reason"]
            asked = Decision.NEW_ROLLOUT, reason, Action.ANOTHER_ROLLOUT
            decisions.append(decision_record(*asked, excitation=excitation, is_from_check=True))
        self.posterior = settled.posterior
        prepared = settled.posterior.preparation
        assert prepared is not None  # of rollouts there always is one
        record: dict[str, Any] = {
            "decision": decisions[-1]["decision"],
            "reason": decisions[-1]["reason"],
            "num_rollouts": len(self.rollouts),
            "decisions": decisions,
            "effects": effect_names(self.model.model),
            "internal_model": self.domain,
            "parameters": describe(settled.data)["parameters"],
            "preparation": prepared.summary.to_dict(),
            "checks": checks,
            **(trained or {}),
        }
        if faults := settled.posterior.provenance.faults:
            record["faults"] = faults
        return record

    def _take_over(self, index: int, saved: dict[str, Any], report: Reporter) -> None:
        """Repeats the steps of a finished iteration that change the loop's own state."""
        decisions = saved["decisions"]
        for number, decision in enumerate(decisions):
            if decision["action"] == Action.ANOTHER_ROLLOUT:
                self._collect_excitation(None)  # read from disk
            if decision["action"] == Action.REVISED:
                self._revised(index, decisions[:number], report)
        following = self.folder.iteration(index + 1)
        if saved["parameters"] and (following is None or not following["parameters"]):
            # This is the last iteration with a posterior, which is read from disk.
            self.posterior = self._infer(index, decisions, report)
        self.domain = saved["internal_model"]
        if not is_final(saved):
            policy = self.folder.policy(index + 1)
            if policy is None:
                raise DataError(f"{self.folder.path} lacks policy {index + 1}.")
            self._use(policy[0])

    def _infer_and_decide(
        self, index: int, real_return: float, decisions: list[dict[str, Any]], report: Reporter
    ) -> Settled:
        """Infers the posterior and follows its diagnosis until no new inference is needed.

        Args:
            index: Number of the iteration.
            real_return: Its mean return on the target.
            decisions: The iteration's decisions so far; more are appended.
            report: Where to report progress.
        """
        loop = self.loop
        self._discover_first(index, decisions, report)
        may_revise = self.model.revise is not None or self.discovers == "after diagnosis"
        while True:
            posterior = self._infer(index, decisions, report)
            data = posterior.to_arviz(PREDICTIVE_DRAWS, seed=self.seed)
            extra_rounds = loop.extra_rounds if self.backend.is_sequential else 0
            diagnosis = diagnose(
                data,
                loop.thresholds,
                rounds_left=extra_rounds - count_actions(decisions, Action.MORE_ROUNDS),
                rollouts_left=self.rollouts.extra_left(index),
            )
            decision, reason = diagnosis.decision, diagnosis.reason
            action = action_for(decision, loop, may_revise=may_revise, real_return=real_return)
            excitation = None
            if action is Action.ANOTHER_ROLLOUT:
                excitation = self._collect_excitation(posterior)
            elif action is Action.MORE_ROUNDS:
                pass  # inference continues; the number of rounds follows from the decisions
            elif may_revise and (action is Action.REVISED or self.discovers != "never"):
                may_revise = False
                is_found, finding = self._revised(index, decisions, report)
                reason = f"{reason} {finding}".strip()
                if is_found:
                    decision, action = Decision.REVISE_MODEL, Action.REVISED
                elif action is Action.REVISED:
                    action = Action.NOTHING_FOUND
            if action is Action.KEPT and decision is Decision.ACCEPT:
                decision = Decision.STOP
                reason = enough(real_return)
            decisions.append(
                decision_record(
                    decision, reason, action, diagnosis.to_dict(), excitation=excitation
                )
            )
            if action not in (Action.MORE_ROUNDS, *NEW_ATTEMPTS):
                return Settled(posterior, data, action)

    def _discover_first(
        self, index: int, decisions: list[dict[str, Any]], report: Reporter
    ) -> None:
        """Takes discovery's steps before inference, and appends their decisions."""
        steps, wanted = self.rollouts.num_steps, self.task.num_steps
        is_short = steps < LEAST_SHARE * wanted
        if self.discovers != "never" and is_short and self.rollouts.extra_left(index) > 0:
            excitation = self._collect_excitation(None)
            reason = f"The rollouts ended early, after {steps} steps of {wanted}: record another."
            asked = Decision.NEW_ROLLOUT, reason, Action.ANOTHER_ROLLOUT
            decisions.append(decision_record(*asked, excitation=excitation))
        if self.discovers == "before inference":
            is_found, reason = self._revised(index, decisions, report)
            if is_found:
                decisions.append(decision_record(Decision.REVISE_MODEL, reason, Action.REVISED))

    def _collect_excitation(self, posterior: Posterior | None) -> dict[str, Any] | None:
        """Records a rollout that should tell more; returns its excitation as in ``train.json``."""
        episode = len(self.rollouts)
        saved = self.folder.excitation(episode)
        if saved is not None or self.target.is_recorded:
            self.rollouts.collect(self.policy, self.domain)  # from disk, or recorded earlier
            return saved
        chosen = chosen_excitation(
            self.task,
            self.policy,
            self.model.proposal,
            posterior,
            self.domain,
            seed=derived_seed(self.seed, "excitation", episode),
            compares=self.loop.compares_excitations,
        )
        self.rollouts.collect(chosen.policy, self.domain)
        self.folder.save_excitation(episode, chosen.to_dict())
        return chosen.to_dict()

    def _revised(
        self, index: int, decisions: Sequence[Mapping[str, Any]], report: Reporter
    ) -> tuple[bool, str]:
        """Searches for missing effects; uses a new folder after a check asked for a rollout."""
        folder = self.folder.revision(index, count_checks(decisions))
        return self.model.look(self.rollouts.joined(), folder, report)

    def _infer(
        self, index: int, decisions: Sequence[Mapping[str, Any]], report: Reporter
    ) -> Posterior:
        """Infers the posterior after the decisions; saved rounds are not repeated."""
        loop = self.loop
        attempt = count_actions(decisions, *NEW_ATTEMPTS)
        rounds = loop.rounds if self.backend.is_sequential else 1
        return infer_posterior(
            self.model.model,
            self.rollouts.joined(None if loop.rollouts_used == "all" else loop.rollouts),
            self.options,
            loop,
            self.backend,
            rounds=rounds + count_actions(decisions, Action.MORE_ROUNDS),
            prior=self.model.prior,
            last=self.posterior,
            near=self.model.near,
            seed=derived_seed(self.seed, "inference", index, attempt),
            checkpoint=self.folder.inference(index, attempt),
            report=report,
        )

    def _prior_domains(self, number: int) -> Domains:
        with seeded(self.seed, "prior domains"):
            return domains_at(self.model.prior, self.model.prior.sample(number))

    @property
    def _start(self) -> Tensor:
        """Policy parameters from which a search begins."""
        return (self.policy if self.loop.is_warm_start else self.task.policy).parameters

    def _use(self, parameters: Tensor) -> None:
        """Makes the policy with these parameters the current one."""
        if parameters.shape != self.task.policy.parameters.shape:
            raise DataError(
                f"{self.folder.path} holds a policy with {parameters.numel()} parameters, but the "
                f"task's has {self.task.policy.parameters.numel()}."
            )
        self.policy = self.task.policy.with_parameters(parameters.to(self.task.policy.parameters))

    def _train(
        self, index: int, settled: Settled, checks: list[dict[str, Any]], report: Reporter
    ) -> dict[str, Any] | None:
        """Trains the next policy; returns its figures, ``None`` if a rollout is needed first."""
        trained = self.training.train(
            index,
            settled,
            self._start,
            self.domain,
            checks,
            rollouts_left=self.rollouts.extra_left(index),
            optimise=partial(self._optimise, report),
        )
        if trained is None:
            return None
        self._use(trained.parameters)
        return trained.figures

    def _optimise(
        self,
        report: Reporter,
        domains: Domains,
        start: Tensor,
        risk: Risk,
        number: tuple[int, ...],
    ) -> tuple[Tensor, dict[str, Any]]:
        """Searches for a policy and returns its parameters and figures of the search."""
        loop = self.loop
        found = optimise_policy(
            self.task,
            domains,
            self.search,
            start,
            iterations=loop.search_iterations,
            num_initial_states=loop.num_initial_states,
            seed=derived_seed(self.seed, "policy", *number),
            risk=risk,
            # Policies are searched with the internal model they will be deployed with.
            internal_model=self.domain,
            expected_calls=loop.search_iterations * (loop.iterations + 1),
            progress=report.stage("train the policy"),
        )
        return found.parameters, found.figures()
