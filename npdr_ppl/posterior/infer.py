"""`infer`: a model, data and a backend in, a posterior out (INFER of Algorithm 1)."""

import logging
import time
from dataclasses import replace
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from npdr_ppl.engines.workers import collect_faults, report_progress
from npdr_ppl.errors import BackendError, NpdrError
from npdr_ppl.inference.base import Backend, Density, Problem, RoundInfo, State
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.language.model import Model
from npdr_ppl.memory import release_freed_memory
from npdr_ppl.posterior.estimator_check import check_estimator
from npdr_ppl.posterior.posterior import Posterior, PosteriorBase, Provenance
from npdr_ppl.posterior.prepare import Preparation, prepare
from npdr_ppl.posterior.run_folder import RunFolder
from npdr_ppl.preparation.binding import BoundModel, Data, bind, problem_of
from npdr_ppl.preparation.data_options import (
    MAX_READINGS_PER_CHUNK,
    PLAIN_FEATURES,
    DataOptions,
    checked_options,
)
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import claimed, reading_back

__all__ = ["infer", "run_round", "simulate_features"]

_LOGGER = logging.getLogger(__name__)

CHUNKS_BETWEEN_RELEASES = 16
"""Chunks of simulations after which freed memory is returned to the operating system."""


def infer(
    model: Model,
    data: Data,
    *,
    backend: str | Backend = "snpe-c",
    rounds: int = 1,
    num_simulations: int = 1_000,
    seed: int = 0,
    options: DataOptions | None = None,
    device: str | torch.device = "cpu",
    start: PosteriorBase | Density | None = None,
    checkpoint: str | PathLike[str] | None = None,
    preparation: Preparation | None = None,
    corrects: bool = True,
    progress: bool | Reporter | None = None,
) -> Posterior:
    """Infers the posterior over a model's domain parameters from measured data.

    Args:
        model: A Pyro model whose observation is a black-box site.
        data: Measured rollouts, or a tensor for a plain function's output; a dictionary of them
            by site name if the model has several black-box sites.
        backend: Name of a backend, or one with options of its own.
        rounds: Rounds of proposing, simulating and training; a backend that does not simulate
            has its posterior after one.
        num_simulations: Simulations of each round.
        seed: Seed of everything random.
        options: How the data are prepared; defaults if left out.
        device: Where trajectories are simulated and the backend trains.
        start: Where the search begins: a posterior of the same model given other data, or another
            density over its reference coordinates. Backends that can correct for it simulate only
            in that region of the prior. If the new posterior lies elsewhere, it is not found.
        checkpoint: Folder to save every round in; an interrupted run continues from there.
        preparation: Result of :func:`~npdr_ppl.posterior.prepare.prepare` for the model and the
            data. Its options replace those given here.
        corrects: Whether a learnt posterior that differs from the simulator is corrected; see
            :mod:`npdr_ppl.posterior.estimator_check`.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The posterior.

    Raises:
        DataError: The data are malformed or do not fit the model.
        ModelError: The model cannot be inferred.
        BackendError: The backend is unknown or cannot handle the model.

    Example:
        >>> import pyro, pyro.distributions as dist, torch
        >>> import npdr_ppl as npdr
        >>> def model():
        ...     mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
        ...     npdr.simulate("x", lambda mean: mean + torch.randn_like(mean), {"mean": mean})
        >>> posterior = npdr.infer(model, torch.tensor(1.0), num_simulations=500, progress=False)
        >>> posterior.sample(100)["mean"].shape
        torch.Size([100])
    """
    if rounds < 1 or num_simulations < 10:
        raise BackendError(
            f"rounds must be at least 1 and num_simulations at least 10, got {rounds} and "
            f"{num_simulations}."
        )
    method = backend_by_name(backend) if isinstance(backend, str) else backend
    if not method.uses_simulations:
        rounds = 1
    options = checked_options(options)
    if preparation is None and isinstance(data, Rollouts):
        if options.initial_state != "uncertain":
            options = replace(options, noise="model")
        preparation = prepare(model, data, options, seed=seed)
    if preparation is not None:
        bound = preparation.bound(device)
    else:
        if options.embedding == "score":
            options = replace(options, embedding=PLAIN_FEATURES)
        bound = bind(model, data, options, device)
    prepared = None if preparation is None or preparation.hypothesis is None else preparation
    problem = problem_of(bound, device)
    states = [method.init(problem)]
    infos: list[RoundInfo] = []
    seconds = {"simulate": 0.0, "train": 0.0}
    folder = None if checkpoint is None else Path(checkpoint)
    store = None if folder is None else RunFolder(folder)
    with reporter(progress) as report, claimed(folder):
        if store is not None:
            store.begin(bound, method, seed=seed, rounds=rounds, num_simulations=num_simulations)
            if prepared is not None:
                store.save_preparation(prepared)
            for index in store.rounds()[:rounds]:
                saved = store.load_round(index)
                with reading_back(store.path):
                    states.append(method.restore(problem, saved.tensors, saved.values))
                    seconds = {stage: saved.seconds[stage] for stage in seconds}
                infos = saved.infos
        with report.overall("all rounds") as done:
            for index in range(len(infos), rounds):
                done(index / rounds, "")
                label = f"round {index + 1}/{rounds}"
                state, info, spent = run_round(
                    bound, method, problem, states[-1], index,
                    num_simulations=num_simulations, seed=seed, report=report, label=label,
                    start=start if index == 0 else None, store=store,
                )  # fmt: skip
                states.append(state)
                seconds = {stage: seconds[stage] + spent[stage] for stage in seconds}
                infos.append(info)
                _LOGGER.info(
                    "%s: %d simulations, %d failed; simulate %.1f s, train %.1f s",
                    label, info.num_simulations, info.num_failed,
                    spent["simulate"], spent["train"],
                )  # fmt: skip
                if store is not None:
                    store.save_round(index, *method.tensors(state), infos, seconds)
        provenance = Provenance(seed, num_simulations, tuple(infos), seconds)
        learnt = Posterior(bound, method, problem, states[1:], provenance, preparation=preparation)
        if bound.likelihood is None:
            return learnt
        step = report.stage("compare with the simulator")
        step(None, "")
        estimator, correction = check_estimator(
            learnt.densities,
            bound.likelihood,
            seed=seed,
            corrects=corrects,
            report=lambda status: step(None, status),
        )
        posterior = learnt.corrected(estimator, correction)
        if store is not None:
            store.save_correction(correction, posterior.checks())
    return posterior


def run_round(
    bound: BoundModel,
    method: Backend,
    problem: Problem,
    state: State,
    index: int,
    *,
    num_simulations: int,
    seed: int,
    report: Reporter,
    label: str = "",
    start: PosteriorBase | Density | None = None,
    store: RunFolder | None = None,
) -> tuple[State, RoundInfo, dict[str, float]]:
    """Proposes, simulates and trains once.

    Args:
        bound: The model and its data.
        method: The backend.
        problem: The problem that the backend gets; its observation may differ from the one in
            ``bound``.
        state: Its state before the round.
        index: Number of the round, from 0.
        num_simulations: Simulations of the round.
        seed: Seed of the run.
        report: Where to report progress.
        label: Words for the progress bar.
        start: An earlier posterior, or another density, to propose from if the backend can.
        store: Where the round's simulations are kept, if anywhere.

    Returns:
        The state after the round, its figures, and the seconds spent to ``simulate`` and
        ``train``.
    """
    started = time.perf_counter()
    with seeded(seed, "propose", index):
        z = None
        if start is not None:
            region = start if isinstance(start, Density) else Mixture(start.densities)
            z = method.ask_near(problem, region, num_simulations)
        z = (method.ask(problem, state, num_simulations) if z is None else z).cpu()
    x = None if store is None else store.simulations(index, z)
    with collect_faults() as collected:
        if x is None:
            x = simulate_features(bound, z, seed, f"round {index}", report, label)
        if store is not None:
            store.save_simulations(index, z, x)
    simulated = time.perf_counter()
    with seeded(seed, "train", index):
        train = report.stage(f"{label}: train", may_end_early=True)
        state, info = method.tell(problem, state, z, x, train)
    info = replace(info, faults=collected.counts())
    spent = {"simulate": simulated - started, "train": time.perf_counter() - simulated}
    return state, info, spent


def simulate_features(
    bound: BoundModel,
    z: Tensor,
    seed: int,
    purpose: str,
    report: Reporter,
    label: str = "",
) -> Tensor:
    """Simulates the model at points and embeds the outputs, chunk by chunk.

    Only features are kept. Memory therefore grows with simulations × steps only if the embedding
    takes raw trajectories.

    Args:
        bound: The model and its data.
        z: Points, ``(n, d)``.
        seed: Seed of the run.
        purpose: Names the random stream.
        report: Where to report progress.
        label: Words for the progress bar.

    Returns:
        Features, ``(n, ...)`` float32; a simulation that failed has a row that is not finite.
    """
    if not len(z):
        return torch.empty(0, *bound.observed_features().shape)
    per_simulation = sum(o.value.numel() for o in bound.observations.values())
    chunk = max(1, min(len(z), MAX_READINGS_PER_CHUNK // max(1, per_simulation)))
    step = report.stage(f"{label}: simulate")

    def simulated(number: float) -> None:
        step(min(1.0, number / len(z)), f"{number:.0f} of {len(z)} simulations")

    simulated(0)
    features = []
    for start in range(0, len(z), chunk):
        part = z[start : start + chunk]

        def within(fraction: float, status: str, start: int = start, num: int = len(part)) -> None:
            simulated(start + fraction * num)

        # A stream for each chunk, so that a resumed run simulates the same.
        with seeded(seed, "simulate", purpose, start), report_progress(within):
            features.append(bound.features(bound.prior.execute(part)).float().cpu())
        simulated(start + len(part))
        if (start // chunk) % CHUNKS_BETWEEN_RELEASES == CHUNKS_BETWEEN_RELEASES - 1:
            release_freed_memory()
    result = torch.cat(features)
    if not bool(torch.isfinite(result).flatten(1).all(1).any()):
        raise NpdrError(
            "Every simulation failed (NaN or infinity); check the priors' ranges and the units."
        )
    return result
