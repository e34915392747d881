"""Options of the NPDR loop, and the actions that can follow a decision."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.errors import ModelError
from npdr_ppl.inference.base import Backend
from npdr_ppl.language.model import Model
from npdr_ppl.loop.risk import MeanReturn, Risk, TailMean
from npdr_ppl.policies.policy_search import PolicySearch
from npdr_ppl.posterior.diagnostics import Thresholds
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts

__all__ = ["LOOP_DATA", "NEW_ATTEMPTS", "SPREAD_WIDER", "Action", "LoopOptions", "Model", "Revise"]

LOOP_DATA = DataOptions("score", 50, "uncertain", "float32")
"""How the loop prepares rollouts by default: in segments of 50 steps and in float32. The loop was
validated on hidden rigs with these values."""

Revise = Callable[[Model, Rollouts, Path | None], Model | None]
"""Searches for effects that a model lacks. It takes the model, all real rollouts and a folder of
its own, and returns the revised model, or ``None`` if it found nothing. A resumed run calls it
again with the same folder; it must then return the same result."""


class Action(StrEnum):
    """The action of the loop after a decision."""

    TRAINED = "trained the policy on the posterior"
    MIXED = "trained the policy on the posterior mixed with the prior"
    SPREAD = "trained the policy on the posterior, spread wider"
    MORE_ROUNDS = "added a round"
    ANOTHER_ROLLOUT = "ran another rollout"
    REVISED = "revised the model"
    NOTHING_FOUND = "looked for a missing effect, found none, and spread the domains wider"
    KEPT = "kept the policy"
    LOGGED = "none, decisions are only logged"


# After these actions the posterior is inferred again, in a folder of its own.
NEW_ATTEMPTS = (Action.ANOTHER_ROLLOUT, Action.REVISED)
# After these actions the domains are spread wider for training, because the model is wrong.
SPREAD_WIDER = (Action.SPREAD, Action.NOTHING_FOUND)


@dataclass(frozen=True)
class LoopOptions:
    """Options of Algorithm 1.

    How rollouts are prepared is not among them; see
    :class:`~npdr_ppl.preparation.data_options.DataOptions`.

    Attributes:
        iterations: Iterations of the loop.
        rollouts: Number H of real rollouts in each iteration.
        extra_rollouts: Further real rollouts that diagnoses, checks before deploying and
            confirmations may ask for in the whole run.
        compares_excitations: Whether a further rollout is of the excitation that is expected to
            tell most about the parameters, which may be one of the standard shapes. If not, it is
            of the task's excitation.
        rollouts_used: Whether inference uses all rollouts so far or those of the latest iteration.
        backend: The inference backend, by name or as an object with its own options.
        rounds: Number R of inference rounds in each iteration; one for backends that are not
            sequential.
        extra_rounds: Further rounds that a diagnosis may ask for in each iteration.
        num_simulations: Simulations in each round.
        start: Where inference starts: from the prior; in the neighbourhood of the closest fit,
            if initial states are uncertain; or in later iterations, as in the paper, from the
            last posterior. Backends that cannot start elsewhere start from the prior.
        search: The policy search, by name or as an object with its own options.
        search_iterations: Iterations of each policy search.
        search_restarts: Greatest number of restarts of the search if its policy is unreliable in
            nearly all draws of the posterior. The cause is then a local optimum of the search or
            too wide a spread of the domains, and not the uncertainty of parameters. Each restart
            halves the spread.
        domains: Whether the policy is trained in draws of the posterior or at its most likely
            sample.
        num_domains: Number of domains for training the policy.
        num_initial_states: Number of initial states in each domain.
        risk: The policy search's first objective over the domains: their mean return, or the mean
            return of the worst domains.
        least_success: Share of its simulated episodes, over draws of the posterior and initial
            states, that must succeed before a new policy runs on the target; 0 checks nothing.
            If it fails the check, another rollout is recorded. If no extra rollout is left, the
            policy is trained for the worst domains. The default is the success rate that one
            would expect of the target, which is one draw of the posterior if the model is right.
            The check needs a task with a success threshold.
        num_checked: Draws of the posterior in which a new policy is checked. With 200 the standard
            error of a share of 0.9 is 0.02.
        num_checked_states: Initial states from which it is checked in every draw. Policies that
            fail from one initial state in six passed a check with two.
        tail_share: Share of the domains, in (0, 1], that are the worst domains. Training for them
            maximises their mean return. EPOpt (Rajeswaran et al. 2017) takes a tenth of 240
            domains; a fifth of the default 50 domains leaves ten for the mean.
        is_warm_start: Whether the search continues from the last policy or starts again.
        starts_from_prior: Whether the first policy is trained on the prior or used as the task
            provides it.
        spread: Parameters of the domains are multiplied by random numbers, uniform in
            1 ± ``spread``.
        prior_share: Share of the domains that is drawn from the prior if a diagnosis asks for a
            wider posterior.
        internal_model: Parameters of the policy's internal model on the target: the most likely
            sample's, or nominal.
        deploys: Which policy the run returns: the one with the best measured return, or the
            last one, which has not run on the target yet. It is also the last one if no measured
            return reached the task's threshold.
        follows_decisions: Whether diagnoses change the course of the loop, or are only logged.
        stop_return: Mean real return of an iteration that ends the loop; ``None`` to use all
            iterations.
        stops: Further condition for ending the loop at that return: an accepted posterior, which
            is then available, or none. The latter saves inference and training on a device
            that already does its task.
        num_confirmations: Further rollouts, out of ``extra_rollouts``, that confirm a measured
            return which would end the loop by itself. Of 22 random rigs, four ended with a policy
            that had succeeded once and failed in a third of its later episodes or more.
        thresholds: Thresholds of the diagnosis.
        discovers: When discovery searches all real rollouts so far for effects that the model
            lacks: in each iteration before inference, or after the posterior of the present model
            has been diagnosed, whatever the diagnosis. Discovery's own alarm decides, because a
            model's noise, estimated at its closest fit, can hide an effect from every diagnosis.
        discovery: Settings of discovery's search.
    """

    iterations: int = 5
    rollouts: int = 1
    extra_rollouts: int = 0
    compares_excitations: bool = True
    rollouts_used: Literal["all", "latest"] = "all"
    backend: str | Backend = "snpe-c"
    rounds: int = 3
    extra_rounds: int = 2
    num_simulations: int = 5_000
    start: Literal["prior", "closest fit", "posterior"] = "closest fit"
    search: str | PolicySearch[Any] = "power"
    search_iterations: int = 20
    search_restarts: int = 2
    domains: Literal["posterior", "most likely"] = "posterior"
    num_domains: int = 50
    num_initial_states: int = 4
    risk: Risk = MeanReturn()
    least_success: float = 0.9
    num_checked: int = 200
    num_checked_states: int = 10
    tail_share: float = 0.2
    is_warm_start: bool = True
    starts_from_prior: bool = True
    spread: float = 0.1
    prior_share: float = 0.2
    internal_model: Literal["most likely", "nominal"] = "most likely"
    deploys: Literal["best measured", "last"] = "best measured"
    follows_decisions: bool = True
    stop_return: float | None = None
    stops: Literal["accepted posterior", "measured return"] = "accepted posterior"
    num_confirmations: int = 1
    thresholds: Thresholds = field(default_factory=Thresholds)
    discovers: Literal["never", "before inference", "after diagnosis"] = "never"
    discovery: DiscoveryOptions = field(default_factory=DiscoveryOptions)

    def __post_init__(self) -> None:
        """Checks the options.

        Raises:
            ModelError: One is out of range.
        """
        least = {
            "iterations": 1, "rollouts": 1, "rounds": 1, "num_simulations": 10,
            "search_iterations": 1, "num_domains": 1, "num_initial_states": 1,
            "extra_rollouts": 0, "extra_rounds": 0, "spread": 0, "prior_share": 0,
            "least_success": 0, "num_checked": 1, "num_checked_states": 1,
            "num_confirmations": 0,
        }  # fmt: skip
        for name, low in least.items():
            if not getattr(self, name) >= low:
                raise ModelError(f"{name} must be at least {low}; got {getattr(self, name)}.")
        for name in ("spread", "prior_share", "least_success"):
            if getattr(self, name) > 1:
                raise ModelError(f"{name} must be at most 1; got {getattr(self, name)}.")
        if not 0.0 < self.tail_share <= 1.0:
            raise ModelError(f"tail_share must be above 0 and at most 1; got {self.tail_share}.")

    @property
    def tail(self) -> TailMean:
        """Objective of the policy search if too few episodes succeed."""
        return TailMean(self.tail_share)
