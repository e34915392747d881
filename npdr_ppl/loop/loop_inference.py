"""INFER of Algorithm 1, as the loop calls it."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from npdr_ppl.inference.base import Backend
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.progress import Reporter
from npdr_ppl.rollouts import Rollouts

__all__ = ["infer_posterior"]


def infer_posterior(
    model: Model,
    rollouts: Rollouts,
    data_options: DataOptions,
    options: LoopOptions,
    backend: Backend,
    *,
    rounds: int,
    prior: Prior,
    last: Posterior | None,
    near: Mapping[str, Tensor],
    seed: int,
    checkpoint: Path,
    report: Reporter,
) -> Posterior:
    """Infers the posterior; rounds that are on disk are not repeated.

    Args:
        model: The model.
        rollouts: The observed rollouts.
        data_options: How the rollouts are prepared.
        options: Options of the loop.
        backend: The inference backend.
        rounds: Rounds of inference.
        prior: The model's prior.
        last: Posterior of the last iteration, if there was one; ignored if the model's parameters
            differ from those of ``prior``.
        near: Parameters near which the model is known to fit best; empty if nothing is known.
        seed: Seed of all random numbers.
        checkpoint: Folder of the run.
        report: Where to report progress.
    """
    prepared = prepare(
        model,
        rollouts,
        data_options,
        near=near,
        seed=seed,
        progress=report.stage("find the closest parameters"),
    )
    start = last if options.start == "posterior" and backend.continues else None
    if start is not None and _sites(start.prior) != _sites(prior):
        start = None  # the model was revised, so the coordinates have another meaning
    wants_fit = options.start == "closest fit" and backend.continues
    near_fit = prepared.neighbourhood() if wants_fit else None
    return infer(
        prepared.model,
        rollouts,
        backend=backend,
        rounds=rounds,
        num_simulations=options.num_simulations,
        seed=seed,
        preparation=prepared,
        start=near_fit or start,
        checkpoint=checkpoint,
        progress=report,
    )


def _sites(prior: Prior) -> list[tuple[str, int]]:
    """Returns names and sizes of the latent sites, which define the reference coordinates."""
    return [(site.name, site.shape.numel()) for site in prior.sites]
