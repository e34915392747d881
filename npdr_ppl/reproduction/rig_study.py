"""Returns on hidden rigs: compares ways to choose the domains in which a policy is trained.

These rows of Table 2 of Muratore et al. (2021) cannot be computed from the paper's recordings.
Each method trains a swing-up policy. The policy runs on a rig in another engine, whose parameters
are hidden from the method, and in the nominal simulator. Methods that learn from the rig use
:func:`npdr_ppl.train`; all get the same real rollouts, simulations and iterations of the search.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from npdr_ppl import metrics
from npdr_ppl.errors import TooShortError
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.language.model import Model
from npdr_ppl.loop.control_task import ControlTask, control_task
from npdr_ppl.loop.domains import Domains, domains_at, prior_of
from npdr_ppl.loop.loop_options import LOOP_DATA, LoopOptions
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.loop.policy_optimisation import optimise_policy, returns_of
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.models.effects import CoulombFriction, SensorLowPass
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.policies.base import Policy
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.preparation.data_options import DataOptions, checked_options
from npdr_ppl.progress import Reporter
from npdr_ppl.randomness import derived_seed, seeded
from npdr_ppl.run_files import read_json, write_json
from npdr_ppl.run_records import OutcomeRecord
from npdr_ppl.targets.base import TargetDomain

__all__ = [
    "METHODS",
    "Outcome",
    "RigMethod",
    "furuta_with_effects",
    "run_method",
    "study",
    "summarise",
]


_LOGGER = logging.getLogger(__name__)


def furuta_with_effects() -> Callable[..., Any]:
    """Returns the zoo's model with the rigs' effects that the paper's equations lack."""
    model = add_effect(furuta, CoulombFriction("arm"))
    model = add_effect(model, CoulombFriction("pole"))
    return add_effect(model, SensorLowPass("arm_velocity,pole_velocity"))


@dataclass(frozen=True)
class RigMethod:
    """A way of choosing the domains that a policy is trained in.

    Attributes:
        domains: ``"none"`` leaves the policy untrained; ``"nominal"`` and ``"prior"`` train it
            once, without the rig; ``"posterior"`` uses the loop.
        backend: The loop's backend.
        embedding: Trajectory features of the backend; ``None`` for the loop's default.
        has_effects: Whether the model has the rigs' effects.
        discovers: Whether the loop searches for effects that the model lacks.
    """

    domains: Literal["none", "nominal", "prior", "posterior"]
    backend: str = ""
    embedding: str | None = None
    has_effects: bool = False
    discovers: bool = False


METHODS: Mapping[str, RigMethod] = {
    "default gains": RigMethod("none"),
    "nominal": RigMethod("nominal"),
    "prior": RigMethod("prior"),
    "bayesian-linear-regression": RigMethod("posterior", "bayesian-linear-regression"),
    "bayessim": RigMethod("posterior", "bayessim", "bayessim"),
    "npdr": RigMethod("posterior", "snpe-c"),
    "npdr with effects": RigMethod("posterior", "snpe-c", has_effects=True),
    "npdr with discovery": RigMethod("posterior", "snpe-c", discovers=True),
}
"""The columns of the paper's Table 2, the policy untrained and trained on the prior, the loop on a
model with the effects, and the loop that must find the effects."""


@dataclass(frozen=True)
class Outcome:
    """Result of a method on one rig with one seed.

    Attributes:
        returns: Returns of the last policy on the rig, one per fresh episode.
        sim_return: Its mean return in the nominal simulator.
        iterations: The loop's records; empty for methods without a loop.
    """

    returns: tuple[float, ...]
    sim_return: float
    iterations: Sequence[Mapping[str, Any]] = ()


def run_method(
    method: RigMethod,
    target: TargetDomain,
    task: ControlTask,
    loop: LoopOptions,
    *,
    options: DataOptions | None = None,
    seed: int,
    num_episodes: int = 3,
    out: Path | None = None,
    progress: bool | Reporter | None = None,
) -> Outcome:
    """Trains a policy by one method and runs it on a rig.

    Args:
        method: The method.
        target: The rig.
        task: The task.
        loop: Options of the loop; those of the policy search apply to every method.
        options: How rollouts are prepared; ``LOOP_DATA`` if ``None``.
        seed: Seed of everything random.
        num_episodes: New episodes on the rig that evaluate the last policy.
        out: Folder for the loop's run.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
    """
    model = furuta_with_effects() if method.has_effects else furuta
    records: Sequence[Mapping[str, Any]] = ()
    domain: Mapping[str, float] = _nominal_values()
    policy = task.policy
    if method.domains == "posterior":
        options = checked_options(options, LOOP_DATA)
        if method.embedding is not None:
            options = replace(options, embedding=method.embedding)
        discovers = "before inference" if method.discovers else "never"
        chosen = replace(loop, backend=method.backend, discovers=discovers)
        try:
            trained = train(
                model,
                target,
                task,
                options=options,
                loop=chosen,
                out=out,
                seed=seed,
                progress=progress,
            )
            policy, domain, records = trained.policy, trained.domain, trained.iterations
        except TooShortError as error:
            # A rollout that ended early can be too short for a method; the prior's policy is used.
            _LOGGER.warning("%s", error)
            policy = _trained_once(METHODS["prior"], model, target, task, loop, seed)
    elif method.domains != "none":
        policy = _trained_once(method, model, target, task, loop, seed)
    real = RealRollouts(target, task, Furuta())
    returns = []
    for episode in range(num_episodes):
        own = derived_seed(seed, "judged episode", episode)
        rollout = real.collect(episode, policy, domain, seed=own)
        assert rollout.rewards is not None
        returns.append(float(rollout.rewards[0].sum()))
    generator = torch.Generator().manual_seed(derived_seed(seed, "nominal episodes"))
    starts = task.initial_states(loop.num_initial_states, generator)
    in_simulation = returns_of(task, _nominal(), policy.parameters[None], starts)
    return Outcome(tuple(returns), float(in_simulation.mean()), records)


def study(
    methods: Sequence[str],
    rigs: Sequence[str],
    seeds: Sequence[int],
    loop: LoopOptions,
    out: Path,
    *,
    options: DataOptions | None = None,
    progress: bool | Reporter | None = None,
    note: Callable[[str, str, int, Outcome], None] | None = None,
) -> dict[str, dict[str, list[Outcome]]]:
    """Runs methods on rigs with several seeds; existing results in the folder are reused.

    Args:
        methods: Labels of :data:`METHODS`.
        rigs: Names for :func:`~npdr_ppl.models.furuta_targets.furuta_target`.
        seeds: Seeds of the training.
        loop: Options of the loop.
        out: Folder for all runs.
        options: How rollouts are prepared; ``LOOP_DATA`` if ``None``.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
        note: Called with method, rig, seed and outcome of every run.

    Returns:
        Outcomes by method and rig, one per seed.
    """
    task = control_task("furuta-swing-up")
    found: dict[str, dict[str, list[Outcome]]] = {}
    for label in methods:
        found[label] = {}
        for rig in rigs:
            found[label][rig] = []
            for seed in seeds:
                folder = out / f"{label.replace(' ', '_')}__{rig}__{seed}"
                file = folder / "outcome.json"
                if file.exists():
                    saved = read_json(file, OutcomeRecord)
                    records = saved.get("iterations", [])
                    outcome = Outcome(tuple(saved["returns"]), saved["sim_return"], records)
                else:
                    folder.mkdir(parents=True, exist_ok=True)
                    outcome = run_method(
                        METHODS[label],
                        furuta_target(rig),
                        task,
                        loop,
                        options=options,
                        seed=seed,
                        out=folder / "run",
                        progress=progress,
                    )
                    write_json(file, asdict(outcome))
                found[label][rig].append(outcome)
                if note is not None:
                    note(label, rig, seed, outcome)
    return found


def summarise(outcomes: Mapping[str, Sequence[Outcome]], success: float) -> dict[str, Any]:
    """Returns mean and standard deviation over rigs and seeds, and the share of successes.

    Each pair of rig and seed enters as its mean over episodes, which are nearly identical.

    Args:
        outcomes: Outcomes of one method by rig.
        success: Return above which a run is a success.
    """
    runs = [outcome for several in outcomes.values() for outcome in several]
    rig = torch.tensor([sum(run.returns) / len(run.returns) for run in runs], dtype=torch.float64)
    simulated = torch.tensor([run.sim_return for run in runs], dtype=torch.float64)
    return {
        "return_rig": metrics.summarise(rig),
        "return_sim": metrics.summarise(simulated),
        "success": float((rig > success).double().mean()),
        "runs": len(runs),
    }


def _trained_once(
    method: RigMethod,
    model: Model,
    target: TargetDomain,
    task: ControlTask,
    loop: LoopOptions,
    seed: int,
) -> Policy:
    """Trains a policy without the rig, with as many iterations as the loop's first policy."""
    domains = _nominal()
    if method.domains == "prior":
        prior = prior_of(model, target.sensors, target.actions, target.time_step)
        with seeded(seed, "prior domains"):
            domains = domains_at(prior, prior.sample(loop.num_domains))
    search = loop.search
    return optimise_policy(
        task,
        domains,
        policy_search(search) if isinstance(search, str) else search,
        task.policy.parameters,
        iterations=loop.search_iterations,
        num_initial_states=loop.num_initial_states,
        seed=derived_seed(seed, "policy", 0),
        internal_model=_nominal_values(),  # as on the rig
    ).policy


def _nominal_values() -> dict[str, float]:
    """Returns the nominal parameters of the simulator."""
    return {name: float(value) for name, value in Furuta().nominal().items()}


def _nominal() -> Domains:
    """Returns the nominal simulator as the only domain."""
    nominal = {name: value[None] for name, value in Furuta().nominal().items()}
    return Domains(Furuta(), nominal)
