"""Is a posterior calibrated? Simulate truths and data, infer, and compare with the truths.

A posterior q(z | x) is calibrated if, for parameters z* from the prior and data x from the
simulator at z*, the truth z* is distributed as a draw of q(z | x). Then the rank of any quantity
at z* among its values at L draws of q is uniform on 0 … L. Three kinds are ranked:

* each parameter: simulation-based calibration (Talts et al. 2018,
  https://arxiv.org/abs/1804.06788);
* the density q itself, which gives the expected coverage of highest-density regions (Hermans et
  al. 2022, https://arxiv.org/abs/2110.06581; Deistler et al. 2022,
  https://arxiv.org/abs/2210.04815);
* the distance to a random reference point, TARP (Lemos et al. 2023,
  https://arxiv.org/abs/2302.03026). The reference points depend on the data: otherwise the prior
  in place of the posterior would look calibrated, as it does to the two above.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import BackendError, SimulationError
from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, fit_preconditioner
from npdr_ppl.language.prior import Prior
from npdr_ppl.posterior.calibration.calibration_result import HIGHEST_DENSITY, TARP, Calibration
from npdr_ppl.posterior.infer import run_round, simulate_features
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.randomness import derived_seed, seeded

__all__ = ["calibrate"]

NUM_DATASETS, NUM_REFITS = 300, 50
"""Default numbers of data sets. With 300, a coverage of 80 % is known to ± 4.5 points with 95 %
confidence. A refit costs as much as the whole inference, so their default is smaller."""

MIN_DATASETS = 20
"""Least number of data sets; with fewer, miscalibration cannot be distinguished from chance."""

MAX_REFERENCE_FEATURES = 512
"""Greatest number of features on which the reference points of TARP depend; of more features,
evenly spaced ones are used."""


def calibrate(
    posterior: Posterior,
    *,
    num_datasets: int | None = None,
    num_draws: int = 999,
    thin: int = 1,
    refit: bool = False,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> Calibration:
    """Tests whether a posterior is calibrated, by simulated data sets with known parameters.

    The model's own prior, simulator and noise generate the data, with the recording's inputs; the
    recording itself plays no part. Failed simulations are dropped here as in training.

    Args:
        posterior: A posterior. If it took one round of a backend that amortises, its trained
            state is evaluated at every data set.
        num_datasets: Data sets N to simulate; 300, or 50 with ``refit``, if ``None``.
        num_draws: Posterior draws L for each. With L + 1 a multiple of 200 the usual levels of
            coverage fall between two ranks.
        thin: Keeps every ``thin``-th draw, for backends whose draws are autocorrelated: ranks
            are uniform only among independent ones (Talts et al. 2018).
        refit: Repeats the whole inference, all rounds, for every data set. Posteriors that hold
            for one observation only, sequential ones among them, need it.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The ranks, with their tests and coverage.

    Raises:
        BackendError: The posterior holds for its own observation only and ``refit`` is false, or
            an argument is out of range.
        SimulationError: Too few simulations succeeded.
    """
    if num_datasets is None:
        num_datasets = NUM_REFITS if refit else NUM_DATASETS
    if num_datasets < MIN_DATASETS or num_draws < 1 or thin < 1:
        raise BackendError(
            f"calibrate needs at least {MIN_DATASETS} data sets, one draw and thin=1; got "
            f"{num_datasets}, {num_draws} and {thin}."
        )
    if not refit:
        _check_amortised(posterior)
    with reporter(progress) as report:
        # As many simulations again decide where the reference points lie: points fitted to the
        # truths they are compared with would not be independent of them.
        with seeded(seed, "calibrate", "truths"):
            z = posterior.prior.sample(2 * num_datasets).float()
        x = simulate_features(posterior.bound, z, seed, "calibrate", report, "calibrate")
        finite = x.flatten(1).isfinite().all(1)
        truths, observations = z[:num_datasets], x[:num_datasets]
        kept, other = finite[:num_datasets], finite[num_datasets:]
        if min(int(kept.sum()), int(other.sum())) < MIN_DATASETS:
            raise SimulationError(
                f"Only {int(kept.sum())} of {num_datasets} simulated data sets are finite; "
                f"calibration needs {MIN_DATASETS}. Check the simulator over the whole prior."
            )
        truths, observations = truths[kept], observations[kept]
        references = _References(z[num_datasets:][other], x[num_datasets:][other])
        members_given = (
            _refitted(posterior, observations, seed, report)
            if refit
            else posterior.backend.densities_given(
                posterior.problem, posterior.states[-1], observations
            )
        )
        names = _names(posterior.prior)
        ranks = np.empty((len(truths), len(names) + 2), dtype=np.int64)
        step = report.stage("calibrate: infer")
        for index, members in enumerate(members_given):
            with seeded(seed, "calibrate", "draws", index):
                draws = _draws(members, num_draws * thin)[::thin]
                points = torch.cat((truths[index][None].to(draws), draws))
                quantities = torch.cat(
                    (
                        _columns(posterior.prior, points),
                        -_log_prob(members, points)[:, None],
                        references.distances(observations[index], points)[:, None],
                    ),
                    dim=1,
                )
                ranks[index] = _ranks(quantities)
            step((index + 1) / len(truths), f"{index + 1} data sets")
    return Calibration(
        parameters=names,
        ranks=ranks[:, :-2],
        density_ranks=ranks[:, -2],
        distance_ranks=ranks[:, -1],
        num_draws=num_draws,
        num_failed=num_datasets - len(truths),
        is_refit=refit,
        seed=seed,
    )


def _check_amortised(posterior: Posterior) -> None:
    name, rounds = posterior.backend.name, len(posterior.provenance.rounds)
    if rounds > 1:
        raise BackendError(
            f"This posterior took {rounds} rounds, so it holds for its own observation only; "
            "give refit=True to repeat the inference for every data set, or calibrate "
            "posterior.after_round(0)."
        )
    if not posterior.backend.amortises:
        raise BackendError(
            f"A posterior of {name} holds for its own observation only; give refit=True to "
            "repeat the inference for every data set."
        )


def _refitted(
    posterior: Posterior, observations: Tensor, seed: int, report: Reporter
) -> Iterator[list[Density]]:
    """Yields the posterior of every member after the whole inference on each observation."""
    own, method = posterior.provenance, posterior.backend
    for index, x in enumerate(observations):
        problem = replace(posterior.problem, observation=x.to(posterior.problem.observation))
        state = method.init(problem)
        for number in range(len(own.rounds)):
            state, _, _ = run_round(
                posterior.bound,
                method,
                problem,
                state,
                number,
                num_simulations=own.num_simulations,
                seed=derived_seed(seed, "calibrate", "refit", index),
                # One bar for all refits; those of each would flood the terminal.
                report=Reporter(),
            )
        yield method.densities(problem, state)


class _References:
    """Random points that depend on the data, and a distance in which to compare with them.

    The points are draws of a linear-Gaussian approximation of the posterior, fitted to simulations
    of their own; distances are in units of its covariance, so that no parameter dominates.

    Args:
        z: Parameters from the prior, ``(n, d)``.
        x: Their features, ``(n, ...)``.
    """

    def __init__(self, z: Tensor, x: Tensor) -> None:
        num_features = x[0].numel()
        self._every = -(-num_features // MAX_REFERENCE_FEATURES)
        self._fit: Preconditioner = fit_preconditioner(z, self._thinned(x))

    def _thinned(self, x: Tensor) -> Tensor:
        return x.flatten(1)[:, :: self._every]

    def distances(self, observation: Tensor, points: Tensor) -> Tensor:
        """Returns the distances of points, ``(n, d)``, to a fresh reference, ``(n,)``."""
        f = self._fit.features(self._thinned(observation[None]))
        reference = self._fit.unwhiten(torch.randn(1, points.shape[1]), f)
        return self._fit.spread(points.float() - reference).norm(dim=-1).double()


def _draws(members: Sequence[Density], num_draws: int) -> Tensor:
    """Draws from the members' mixture, ``(num_draws, d)``.

    The members' shares are random, unlike in :class:`Mixture`: fixed ones would make the draws
    more even than independent ones.
    """
    shares = torch.randint(len(members), (num_draws,)).bincount(minlength=len(members))
    draws = [member.sample(int(n)) for member, n in zip(members, shares, strict=True) if n]
    return torch.cat([part.cpu() for part in draws])


def _log_prob(members: Sequence[Density], points: Tensor) -> Tensor:
    with torch.no_grad():
        log_prob = Mixture(members).log_prob(points).double().cpu()
    if bool(log_prob.isnan().any()):
        raise BackendError("The posterior's log density is NaN at some of its own draws.")
    return log_prob


def _columns(prior: Prior, points: Tensor) -> Tensor:
    """Returns the values of all scalar parameters at points ``(n, d)``, ``(n, P)``."""
    values = prior.to_parameters(points)
    return torch.cat([values[s.name].reshape(len(points), -1).double() for s in prior.sites], 1)


def _names(prior: Prior) -> tuple[str, ...]:
    """Returns a name for every scalar parameter; elements of arrays have their position."""
    names = []
    for site in prior.sites:
        if site.shape == torch.Size():
            names.append(site.name)
        else:
            positions = np.ndindex(tuple(site.shape))
            names += [f"{site.name}[{','.join(map(str, index))}]" for index in positions]
    for reserved in (HIGHEST_DENSITY, TARP):
        if reserved in names:
            raise BackendError(f"A parameter may not be called {reserved!r} to be calibrated.")
    return tuple(names)


def _ranks(quantities: Tensor) -> NDArray[np.int64]:
    """Returns how many of the rows below the first are smaller, by column; ties at random.

    Without the random choice, draws equal in the float format would all count on one side.
    """
    truth, draws = quantities[0], quantities[1:]
    below, equal = (draws < truth).sum(0), (draws == truth).sum(0)
    share = (torch.rand(len(truth)) * (equal + 1)).floor().long().clamp(max=equal)
    return (below + share).numpy()
