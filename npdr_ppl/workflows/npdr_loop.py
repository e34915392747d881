"""The NPDR loop, Algorithm 1 of Muratore et al. (2021), driven by diagnostics.

An iteration runs the policy on the target domain, infers the domain parameters from what was
recorded, lets the diagnosis of that posterior decide what to do about it, and trains the policy in
domains drawn from it::

    policy ← POLOPT(prior)
    repeat
        rollouts ← run the policy on the target, its internal model being the most likely sample
        model ← discover(model, rollouts), if the options say so
        posterior ← INFER(model, rollouts), in rounds
        decision ← diagnose(posterior): accept, more rounds, another rollout, revise the model,
                   widen, stop
        policy ← POLOPT(posterior)

With a folder, every rollout, round and policy is on disk before the next step, and a run that was
killed continues to the same result; see :mod:`npdr_ppl.workflows.loop_folder`.
"""

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.policies.base import Policy
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.randomness import derived_seed, seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import TargetDomain
from npdr_ppl.workflows.control_task import ControlTask
from npdr_ppl.workflows.diagnostics import Decision, diagnose
from npdr_ppl.workflows.domains import (
    Domains,
    domains_at,
    most_likely_domain,
    prior_of,
    simulator_of,
)
from npdr_ppl.workflows.fit import describe
from npdr_ppl.workflows.loop_decisions import Settled, action_for, decision_record, is_final
from npdr_ppl.workflows.loop_discovery import LoopDiscovery, effect_names
from npdr_ppl.workflows.loop_domains import training_domains
from npdr_ppl.workflows.loop_folder import LoopFolder
from npdr_ppl.workflows.loop_inference import infer_posterior
from npdr_ppl.workflows.loop_options import NEW_ATTEMPTS, Action, LoopOptions, Model, Revise
from npdr_ppl.workflows.loop_result import Training, Tried, best_measured
from npdr_ppl.workflows.policy_optimisation import optimise_policy
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.progress import Reporter, reporter
from npdr_ppl.workflows.real_rollouts import RealRollouts
from npdr_ppl.workflows.run_folder import plain

__all__ = ["Training", "train"]

_LOGGER = logging.getLogger(__name__)

PREDICTIVE_DRAWS = 500
"""Draws per ensemble member that a diagnosis reads."""

LEAST_SHARE = 0.5
"""Share of an episode's steps that discovery wants: effects that show in few segments of a rollout
that ended early are told from chance, but not from each other."""


def train(
    model: Model,
    target: TargetDomain,
    task: ControlTask,
    options: LoopOptions | None = None,
    *,
    out: str | PathLike[str] | None = None,
    revise: Revise | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> Training:
    """Trains a policy for a target domain that differs from its simulator.

    Args:
        model: A Pyro model of the target with one black-box site.
        target: The target domain; its parameters stay unknown.
        task: What the policy is to do.
        options: Options of the loop.
        out: Folder for the run, ``train.json`` included; a run killed there continues.
        revise: What looks for a missing effect where a diagnosis asks for it.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Raises:
        DataError: The target's channels do not fit, or the folder holds another run.
        ModelError: The model cannot be trained on; see
            :func:`npdr_ppl.workflows.domains.simulator_of`.
    """
    options = options or LoopOptions()
    with reporter(progress) as report, ExitStack() as stack:
        path = out or stack.enter_context(TemporaryDirectory(prefix="npdr-"))
        folder = LoopFolder(Path(path))
        loop = _Loop(model, target, task, options, folder, revise, seed, report)
        # Only now: a model or target that does not fit leaves no folder of a run.
        folder.begin(model, target, task, options, seed=seed)
        return loop.run()


class _Loop:
    """The state of one run."""

    def __init__(
        self,
        model: Model,
        target: TargetDomain,
        task: ControlTask,
        options: LoopOptions,
        folder: LoopFolder,
        revise: Revise | None,
        seed: int,
        report: Reporter,
    ) -> None:
        self.model = model
        self.target = target
        self.task = task
        self.options = options
        self.folder = folder
        self.revise = revise
        # A way of one's own to look for effects takes the place of discovery.
        may_discover = options.follows_decisions and revise is None
        self.discovers = options.discovers if may_discover else "never"
        self.discovery = LoopDiscovery(
            model, options.discovery, derived_seed(seed, "discovery in the loop")
        )
        self.seed = seed
        self.report = report
        search, backend = options.search, options.backend
        self.search = policy_search(search) if isinstance(search, str) else search
        self.backend = backend_by_name(backend) if isinstance(backend, str) else backend
        self.prior = prior_of(model, target.sensors, target.actions, target.time_step)
        simulator = simulator_of(self.prior)
        self.domain = {name: float(value) for name, value in simulator.nominal().items()}
        self.real = RealRollouts(target, task, simulator, folder.rollouts)
        self.rollouts: list[Rollouts] = []
        self.near: Mapping[str, Tensor] = {}
        self.policy = task.policy
        self.posterior: Posterior | None = None
        self.records: list[dict[str, Any]] = []
        self.tried: list[Tried] = []

    def run(self) -> Training:
        """Runs all iterations, or those that are left."""
        if not self._can_collect(self.options.rollouts):
            raise DataError(
                f"{self.target.name} has {self.target.num_episodes} episodes; an iteration takes "
                f"{self.options.rollouts}."
            )
        if self.options.starts_from_prior:
            self._optimise(0, self._prior_domains(self.options.num_domains), self.report)
        for index in range(self.options.iterations):
            report = self.report.under(f"iteration {index + 1}/{self.options.iterations}")
            if not self._can_collect(self.options.rollouts):
                _LOGGER.warning(
                    "All %d episodes of %s have been used, after %d of %d iterations.",
                    self.target.num_episodes, self.target.name, index, self.options.iterations,
                )  # fmt: skip
                break
            self.records.append(self._iterate(index, report))
            self.folder.write_result(self._result().to_dict())
            if is_final(self.records[-1]):
                break
        return self._result()

    def _result(self) -> Training:
        best = best_measured(self.tried, self.options.deploys, self.task.success)
        return Training(
            self.policy if best is None else self.tried[best].policy,
            self.domain if best is None else self.tried[best].domain,
            best,
            list(self.records),
            _joined(self.rollouts),
            self.posterior,
            self.model,
        )

    def _can_collect(self, number: int) -> bool:
        """Returns whether the target has so many episodes left."""
        limit = self.target.num_episodes
        return limit is None or len(self.rollouts) + number <= limit

    def _collect(self, policy: Policy) -> Rollouts:
        """Runs the next episode on the target."""
        episode = len(self.rollouts)
        seed = derived_seed(self.seed, "episode", episode)
        self.rollouts.append(self.real.collect(episode, policy, self.domain, seed=seed))
        return self.rollouts[-1]

    def _iterate(self, index: int, report: Reporter) -> dict[str, Any]:
        """Runs one iteration, or takes over what an earlier process made of it."""
        new = [self._collect(self.policy) for _ in range(self.options.rollouts)]
        returns = [float(rollout.rewards[0].sum()) for rollout in new if rollout.rewards]
        real_return = sum(returns) / len(returns)
        self.tried.append(Tried(self.policy, self.domain, real_return))
        saved = self.folder.iteration(index)
        if saved is not None:
            self._take_over(index, saved, report)
            return saved
        settled = self._infer_and_decide(index, real_return, report)
        self.posterior = settled.posterior
        last = settled.decisions[-1]
        is_last = is_final({"decisions": settled.decisions})
        if self.options.internal_model == "most likely" and not is_last:
            self.domain = most_likely_domain(settled.posterior, seed=self.seed)
        record: dict[str, Any] = {
            "decision": last["decision"],
            "reason": last["reason"],
            "real_return": real_return,
            "real_returns": returns,
            "num_rollouts": len(self.rollouts),
            "decisions": settled.decisions,
            "effects": effect_names(self.model),
            "internal_model": self.domain,
            "parameters": describe(settled.data)["parameters"],
        }
        if faults := settled.posterior.provenance.faults:
            record["faults"] = faults
        if not is_last:
            domains = self._posterior_domains(index, settled)
            record |= self._optimise(index + 1, domains, report)
        record = plain(record)
        self.folder.save_iteration(index, record)
        return record

    def _take_over(self, index: int, saved: dict[str, Any], report: Reporter) -> None:
        """Repeats the steps of a finished iteration that change more than its record."""
        rounds, attempt = self._rounds(), 0
        for decision in saved["decisions"]:
            action = decision["action"]
            if action == Action.ANOTHER_ROLLOUT:
                self._collect(self.task.excitation or self.policy)
            if action == Action.REVISED:
                self._revised(index, report)
            rounds += action == Action.MORE_ROUNDS
            attempt += action in NEW_ATTEMPTS
        if self.folder.iteration(index + 1) is None:
            # The last one finished: its posterior is read from disk.
            self.posterior = self._infer(index, attempt, rounds, report)
        self.domain = saved["internal_model"]
        if not is_final(saved):
            self._optimise(index + 1, None, report)

    def _rounds(self) -> int:
        """Returns how many rounds inference has before any is added."""
        return self.options.rounds if self.backend.is_sequential else 1

    def _infer_and_decide(self, index: int, real_return: float, report: Reporter) -> Settled:
        """Infers the posterior and does what its diagnosis asks for until that settles it."""
        options = self.options
        decisions = self._discover_first(index, report)
        rounds, attempt = self._rounds(), len(decisions)
        extra_rounds = options.extra_rounds if self.backend.is_sequential else 0
        may_revise = self.revise is not None or self.discovers == "after diagnosis"
        while True:
            posterior = self._infer(index, attempt, rounds, report)
            data = posterior.to_arviz(PREDICTIVE_DRAWS, seed=self.seed)
            diagnosis = diagnose(
                data,
                options.thresholds,
                rounds_left=extra_rounds,
                rollouts_left=self._extra_rollouts_left(index),
            )
            decision, reason = diagnosis.decision, diagnosis.reason
            action = action_for(decision, options, may_revise=may_revise, real_return=real_return)
            if action is Action.MORE_ROUNDS:
                rounds, extra_rounds = rounds + 1, extra_rounds - 1
            elif action is Action.ANOTHER_ROLLOUT:
                self._collect(self.task.excitation or self.policy)
            elif may_revise and (action is Action.REVISED or self.discovers != "never"):
                may_revise = False
                is_found, finding = self._revised(index, report)
                reason = f"{reason} {finding}".strip()
                if is_found:
                    decision, action = Decision.REVISE_MODEL, Action.REVISED
                elif action is Action.REVISED:
                    action = Action.NOTHING_FOUND
            if action is Action.KEPT and decision is Decision.ACCEPT:
                decision = Decision.STOP
                reason = f"The return on the target, {real_return:.0f}, is what was asked for."
            decisions.append(decision_record(decision, reason, action, diagnosis.to_dict()))
            attempt += action in NEW_ATTEMPTS
            if action not in (Action.MORE_ROUNDS, *NEW_ATTEMPTS):
                return Settled(posterior, data, decisions, action)

    def _discover_first(self, index: int, report: Reporter) -> list[dict[str, Any]]:
        """Does what discovery wants before anything is inferred, and returns what was decided."""
        decisions: list[dict[str, Any]] = []
        steps, wanted = sum(sum(r.lengths) for r in self.rollouts), self.task.num_steps
        is_short = steps < LEAST_SHARE * wanted
        if self.discovers != "never" and is_short and self._extra_rollouts_left(index) > 0:
            self._collect(self.task.excitation or self.policy)
            reason = f"The rollouts ended early, after {steps} steps of {wanted}: record another."
            decisions.append(decision_record(Decision.NEW_ROLLOUT, reason, Action.ANOTHER_ROLLOUT))
        if self.discovers == "before inference":
            is_found, reason = self._revised(index, report)
            if is_found:
                decisions.append(decision_record(Decision.REVISE_MODEL, reason, Action.REVISED))
        return decisions

    def _extra_rollouts_left(self, index: int) -> int:
        """Returns how many more episodes a diagnosis may ask for."""
        used = len(self.rollouts) - self.options.rollouts * (index + 1)
        left = self.options.extra_rollouts - used
        return left if self._can_collect(1) else 0

    def _revised(self, index: int, report: Reporter) -> tuple[bool, str]:
        """Looks for effects that the model lacks, and gives it what is found.

        Returns:
            Whether the model has effects now that were found, and what was found in a sentence.
        """
        rollouts, folder = _joined(self.rollouts), self.folder.revision(index)
        if self.revise is not None:
            found, finding = self.revise(self.model, rollouts, folder), ""
        else:
            step = report.stage("look for a missing effect")
            revision = self.discovery.look(rollouts, folder, step)
            found, finding = revision.model, revision.reason
            self.near = revision.parameters if found is not None else {}
        if found is None:
            return False, finding
        target = self.target
        self.model = found
        self.prior = prior_of(found, target.sensors, target.actions, target.time_step)
        return True, finding

    def _infer(self, index: int, attempt: int, rounds: int, report: Reporter) -> Posterior:
        """Infers the posterior; rounds that are on disk are not repeated."""
        options = self.options
        number = len(self.rollouts) if options.rollouts_used == "all" else options.rollouts
        return infer_posterior(
            self.model,
            _joined(self.rollouts[-number:]),
            options,
            self.backend,
            rounds=rounds,
            prior=self.prior,
            last=self.posterior,
            near=self.near,
            seed=derived_seed(self.seed, "inference", index, attempt),
            checkpoint=self.folder.inference(index, attempt),
            report=report,
        )

    def _prior_domains(self, number: int) -> Domains:
        with seeded(self.seed, "prior domains"):
            return domains_at(self.prior, self.prior.sample(number))

    def _posterior_domains(self, index: int, settled: Settled) -> Domains:
        """Returns what the policy is trained in next."""
        return training_domains(
            settled.posterior,
            self.options,
            settled.action,
            from_prior=self._prior_domains,
            seed=derived_seed(self.seed, "posterior domains", index),
            most_likely_seed=self.seed,
        )

    def _optimise(self, number: int, domains: Domains | None, report: Reporter) -> dict[str, Any]:
        """Trains policy ``number``, unless it is on disk, and returns the figures."""
        saved = self.folder.policy(number)
        if saved is not None:
            parameters, figures = saved
        elif domains is None:
            raise DataError(f"{self.folder.path} lacks policy {number}.")
        else:
            options = self.options
            found = optimise_policy(
                self.task,
                domains,
                self.search,
                (self.policy if options.is_warm_start else self.task.policy).parameters,
                iterations=options.search_iterations,
                num_initial_states=options.num_initial_states,
                seed=derived_seed(self.seed, "policy", number),
                expected_calls=options.search_iterations * (options.iterations + 1),
                progress=report.stage("train the policy"),
            )
            parameters, figures = found.parameters, found.figures()
            self.folder.save_policy(number, parameters, figures)
        self.policy = self.task.policy.with_parameters(parameters.to(self.task.policy.parameters))
        return figures


def _joined(rollouts: list[Rollouts]) -> Rollouts:
    """Returns several rollouts as one set."""
    first, *others = rollouts
    return first.concatenate(*others) if others else first
