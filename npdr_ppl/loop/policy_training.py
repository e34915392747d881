"""The training of the loop's policies: run POLOPT, check the policy, train it for the tail.

POLOPT is the search in ``policy_optimisation.py``, which ``npdr_loop.py`` passes as ``optimise``.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from torch import Tensor

from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.loop_decisions import Settled
from npdr_ppl.loop.loop_folder import LoopFolder
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.loop.policy_check import Check, NextStep, check_policy, decide
from npdr_ppl.loop.risk import Risk
from npdr_ppl.loop.training_domains import training_domains
from npdr_ppl.randomness import derived_seed
from npdr_ppl.run_files import plain

__all__ = ["LoopTraining", "Optimise", "Trained"]

Figures = dict[str, Any]

Optimise = Callable[[Domains, Tensor, Risk, tuple[int, ...]], tuple[Tensor, Figures]]
"""Searches for a policy in given domains, from initial parameters, with a given objective. The
numbers identify the search within the run. Returns parameters and figures."""


@dataclass(frozen=True)
class Trained:
    """The policy with which the loop continues.

    Attributes:
        parameters: Its parameters.
        figures: Figures of its training and of its check, for the iteration's record.
    """

    parameters: Tensor
    figures: Figures


class LoopTraining:
    """Trains the policies of a run; each is saved before the next step is chosen.

    Args:
        task: The task of the policy.
        options: Options of the loop.
        folder: The run's folder.
        seed: Seed of the run.
        from_prior: Draws a given number of domains from the prior.
    """

    def __init__(
        self,
        task: ControlTask,
        options: LoopOptions,
        folder: LoopFolder,
        seed: int,
        *,
        from_prior: Callable[[int], Domains],
    ) -> None:
        self.task = task
        self.options = options
        self.folder = folder
        self.seed = seed
        self.from_prior = from_prior

    def train(
        self,
        index: int,
        settled: Settled,
        start: Tensor,
        internal_model: Mapping[str, float],
        checks: list[Figures],
        *,
        rollouts_left: int,
        optimise: Optimise,
    ) -> Trained | None:
        """Trains the policy that follows an iteration, and checks it over the posterior.

        Args:
            index: Number of the iteration.
            settled: The posterior and the decisions about it.
            start: Initial policy parameters of the search.
            internal_model: Parameters of the policy's internal model on the target.
            checks: The iteration's checks so far; more are appended.
            rollouts_left: Number of rollouts that can still be recorded.
            optimise: Searches for a policy.

        Returns:
            The policy, already saved; ``None`` if another rollout is needed first.
        """
        options = self.options
        best: tuple[Check, Tensor, Figures] | None = None
        risk, searches_left = options.risk, options.search_restarts
        while True:
            number = index + 1, len(checks)
            saved = self.folder.policy(*number)
            if saved is None:
                domains = self._domains(number, settled, options.search_restarts - searches_left)
                saved = optimise(domains, start, risk, number if number[1] else number[:1])
                self._add_check(saved, settled, internal_model, index)
                self.folder.save_policy(number[0], *saved, draft=number[1])
            parameters, figures = saved[0], dict(saved[1])
            check = Check.of(figures.pop("check"))
            verdict, reason = decide(
                check,
                options,
                searches_left=searches_left,
                rollouts_left=rollouts_left,
                is_for_tail=risk is not options.risk,
            )
            checks.append({**check.to_dict(), "decision": verdict.value, "reason": reason})
            if verdict is NextStep.ANOTHER_ROLLOUT:
                return None
            if best is None or check.is_better_than(best[0]):
                best = check, parameters, figures
            if verdict is NextStep.DEPLOY:
                break
            if verdict is NextStep.SEARCH_AGAIN:
                # Restart from the task's policy, because the search ended in a local optimum, and
                # in a narrower spread, because the optimum is often a compromise between domains.
                start, searches_left = self.task.policy.parameters.double(), searches_left - 1
            else:
                start, risk = best[1], options.tail
        check, parameters, figures = best
        self.folder.save_policy(index + 1, parameters, figures)
        return Trained(parameters, {**figures, **check.to_dict()})

    def _domains(self, number: tuple[int, int], settled: Settled, num_restarts: int) -> Domains:
        """Returns the training domains of a draft of a policy."""
        policy, draft = number
        of_draft = (policy - 1, draft) if draft else (policy - 1,)
        return training_domains(
            settled.posterior,
            self.options,
            settled.action,
            from_prior=self.from_prior,
            seed=derived_seed(self.seed, "posterior domains", *of_draft),
            most_likely_seed=self.seed,
            num_restarts=num_restarts,
        )

    def _add_check(
        self,
        trained: tuple[Tensor, Figures],
        settled: Settled,
        internal_model: Mapping[str, float],
        index: int,
    ) -> None:
        """Checks a policy and adds the result to its figures."""
        parameters, figures = trained
        check = check_policy(
            self.task,
            self.task.policy.with_parameters(parameters.to(self.task.policy.parameters)),
            settled.posterior,
            internal_model,
            self.options,
            # All drafts of a posterior are checked on the same draws, for a fair comparison.
            seed=derived_seed(self.seed, "check", index),
        )
        figures["check"] = plain(asdict(check))
