"""Measures of the misfit of simulations: RMSE, DTW, CRPS, PIT and coverage.

RMSE and DTW compare one simulated series per rollout with the measured one, as the tables of
Muratore et al. (2021) do; the others compare an ensemble of trajectories, i.e. a predictive
distribution, with the observation.
"""

import importlib
import math
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from types import ModuleType
from typing import Literal, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import DependencyError, ShapeError

__all__ = [
    "Summary",
    "c2st",
    "check_c2st",
    "coverage",
    "crps",
    "crps_by_step",
    "dtw",
    "pit",
    "rmse",
    "summarise",
]

MOST_ALIGNED = 3_000
"""Maximum number of steps that dynamic time warping aligns, which needs 200 MB; the paper's
recordings have 2500 steps."""


class Summary(TypedDict):
    """Mean and population standard deviation over rollouts."""

    mean: float
    std: float


def summarise(values: Tensor) -> Summary:
    """Returns mean and population standard deviation of all values, as tables print them."""
    return {"mean": float(values.mean()), "std": float(values.std(correction=0))}


def rmse(simulated: Sequence[Tensor], measured: Sequence[Tensor]) -> Tensor:
    """Root-mean-square error per rollout in units of each channel's range.

    ``RMSE = 1/C Σ_c sqrt(1/T Σ_t ((x_tc − y_tc) / max_t |y_tc|)²)``

    Args:
        simulated: Series x, one ``(..., T, C)`` per rollout, e.g. of
            :func:`npdr_ppl.rollouts.stitch`.
        measured: Series y, one ``(T, C)`` per rollout, in the same units.

    Returns:
        ``(..., R)``, dimensionless.

    Raises:
        ShapeError: The series do not fit each other.

    References:
        Muratore et al., Neural Posterior Domain Randomization, 2021, Tables 1 and 2. The paper
        says that it divides by the state bounds; its numbers come from dividing by the range.
    """
    _check(simulated, measured)
    result = []
    for x, y in zip(simulated, measured, strict=True):
        error = (x - y.to(x)) / _scale(y).to(x)
        result.append(error.square().mean(-2).sqrt().mean(-1))
    return torch.stack(result, dim=-1)


def dtw(
    simulated: Sequence[Tensor],
    measured: Sequence[Tensor],
    *,
    open_end: Literal["simulated", "measured"] = "simulated",
) -> Tensor:
    """Distance of dynamic time warping per rollout, with channels in units of their range.

    With ``d_ij`` the Euclidean distance between step i of the measured and step j of the
    simulated series, both divided by ``max |measured|`` per channel::

        D_ij = min(D_(i−1)(j−1) + 2 d_ij, D_(i−1)j + d_ij, D_i(j−1) + d_ij),   D_00 = d_00

    The alignment starts at the beginning of both series and uses the whole measured one, but may
    leave out the end of the simulated one. The result is ``D_(T−1)j`` for the j at which
    ``D_(T−1)j / (T + j + 1)`` is smallest. In terms of dtw-python: the query is the measured
    series, the step pattern is ``symmetric2``, ``open_end=True``, and the distance is cumulative,
    not normalised.

    Memory grows with the square of the length. For series longer than ``MOST_ALIGNED`` steps, only
    every k-th step is aligned and the distance is multiplied by k. This approximation must not be
    compared with distances of shorter series.

    Args:
        simulated: One ``(..., T, C)`` per rollout.
        measured: One ``(T, C)`` per rollout, in the same units.
        open_end: The series whose end may be left out. With ``"measured"``, the whole simulated
            series is used and the end of the measured one may be left out, so that a simulation
            that moves too little is not penalised.

    Returns:
        ``(..., R)`` float64, dimensionless; NaN where a simulation is not finite.

    Raises:
        ShapeError: The series do not fit each other.

    References:
        H. Sakoe and S. Chiba, Dynamic programming algorithm optimization for spoken word
        recognition, 1978 (the recursion); P. Tormene et al., Matching incomplete time series with
        dynamic time warping, 2009 (the open end).
    """
    _check(simulated, measured)
    result = []
    for x, y in zip(simulated, measured, strict=True):
        scale = _scale(y).double().cpu()
        query = (y.double().cpu() / scale).numpy()
        batch = (x.detach().double().cpu() / scale).reshape(-1, *x.shape[-2:]).numpy()
        if open_end == "simulated":
            values = [_open_end_dtw(query, reference) for reference in batch]
        else:
            values = [_open_end_dtw(reference, query) for reference in batch]
        result.append(torch.tensor(values, dtype=torch.float64).reshape(x.shape[:-2]))
    return torch.stack(result, dim=-1)


def _open_end_dtw(query: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Aligns one query ``(n, C)`` with one reference ``(m, C)``."""
    if not (np.isfinite(reference).all() and np.isfinite(query).all()):
        return math.nan
    stride = -(-max(len(query), len(reference)) // MOST_ALIGNED)
    aligned = _dtw_python().dtw(
        query[::stride], reference[::stride], open_end=True, distance_only=True
    )
    return stride * float(aligned.distance)


@cache
def _dtw_python() -> ModuleType:
    # The import prints a greeting, which would mix with JSON on standard output.
    with redirect_stdout(StringIO()):
        return importlib.import_module("dtw")


def crps(samples: Tensor, observation: Tensor, *, is_fair: bool = False) -> Tensor:
    """Continuous ranked probability score of an ensemble, element by element.

    ``CRPS = 1/B Σ_b |x_b − y| − 1/(2 B²) Σ_b Σ_b' |x_b − x_b'|``; the fair form divides the
    second sum by ``2 B (B − 1)``, which removes the bias of a small ensemble.

    Args:
        samples: Ensemble x, ``(B, ...)``, in the observation's units.
        observation: Observed values y, ``(...)``.
        is_fair: Whether to use the fair form, which needs B > 1.

    Returns:
        ``(...)`` in the observation's units; smaller is better, |x − y| for B = 1.

    Raises:
        ShapeError: The shapes do not fit, or the fair form was given one sample.

    References:
        T. Gneiting and A. Raftery, Strictly proper scoring rules, prediction, and estimation,
        2007, eq. 21; C. Ferro, Fair scores for ensemble forecasts, 2014.
    """
    _check_ensemble(samples, observation)
    size = samples.shape[0]
    if is_fair and size < 2:
        raise ShapeError("the fair CRPS needs two samples, got one.")
    error = (samples - observation.to(samples)).abs().mean(0)
    # In ascending order the i-th sample enters the double sum with weight 2 (2 i − B − 1).
    ordered = samples.sort(dim=0).values
    weights = 2 * torch.arange(1, size + 1).to(samples) - size - 1
    spread = (weights @ ordered.flatten(1)).reshape(observation.shape)
    return error - spread / (size * (size - 1 if is_fair else size))


def crps_by_step(
    samples: Tensor, observation: Tensor, mask: Tensor, *, is_fair: bool = False
) -> Tensor:
    """CRPS of the k-step-ahead prediction: averaged over segments, for each step k.

    Args:
        samples: Trajectories, ``(B, S, K, C)``.
        observation: Measurements after each step, ``(S, K, C)``.
        mask: True for steps that exist, ``(S, K)``.
        is_fair: Whether to use the fair form; see :func:`crps`.

    Returns:
        ``(K, C)`` in the channels' units; row k − 1 is the k-step prediction.
    """
    values = crps(samples, observation, is_fair=is_fair)
    mask = mask.to(values.device)
    values = torch.where(mask[..., None], values, 0.0)
    return values.sum(0) / mask.sum(0).clamp_min(1)[:, None]


def pit(samples: Tensor, observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Probability integral transform: the rank of the observation in the ensemble.

    ``(#{x_b < y} + u (1 + #{x_b = y})) / (B + 1)`` with ``u`` uniform on [0, 1]. It is exactly
    uniform if the observation is a draw from the ensemble's distribution, even with ties.

    Args:
        samples: Ensemble x, ``(B, ...)``.
        observation: Observed values y, ``(...)``.
        generator: Source of ``u``; ``None`` uses ``u = 1/2``.

    Returns:
        ``(...)`` in [0, 1].

    Raises:
        ShapeError: The shapes do not fit.

    References:
        C. Czado et al., Predictive model assessment for count data, 2009 (randomised PIT).
    """
    _check_ensemble(samples, observation)
    observation = observation.to(samples)
    below = (samples < observation).sum(0)
    equal = (samples == observation).sum(0)
    if generator is None:
        u = torch.full(observation.shape, 0.5)
    else:
        u = torch.rand(observation.shape, generator=generator, device=generator.device)
    return (below + u.to(samples) * (1 + equal)) / (samples.shape[0] + 1)


def coverage(pit_values: Tensor, levels: Sequence[float], mask: Tensor | None = None) -> Tensor:
    """Fraction of observations inside the central predictive intervals.

    Args:
        pit_values: Result of :func:`pit`, ``(..., C)`` or any shape.
        levels: Nominal probabilities of the intervals, L of them, in [0, 1].
        mask: Which values count, broadcast against ``pit_values`` from the left, e.g. ``(S, K)``.

    Returns:
        ``(L,)``; calibrated where it equals ``levels``.
    """
    distance = (pit_values - 0.5).abs()
    if mask is not None:
        distance = distance[mask.to(distance.device)]
    bounds = torch.as_tensor(levels, dtype=distance.dtype, device=distance.device) / 2
    # The bound has a rounding error: the interval of level 1 must contain 0 and 1.
    inside = distance.flatten() <= bounds[:, None] + torch.finfo(distance.dtype).eps
    return inside.to(distance.dtype).mean(-1)


def check_c2st() -> None:
    """Checks that :func:`c2st` can be computed; to be called before expensive work.

    Raises:
        DependencyError: scikit-learn is not installed.
    """
    try:
        importlib.import_module("sklearn")
    except ImportError as error:
        raise DependencyError(
            "The classifier test C2ST needs scikit-learn, which is not installed: "
            "pip install scikit-learn."
        ) from error


def c2st(samples: Tensor, reference: Tensor, *, seed: int = 0) -> float:
    """Classifier two-sample test: how well a network distinguishes two sets of samples.

    The result is the cross-validated accuracy (5 folds) of a perceptron with two hidden layers of
    10 d units, on data standardised by the reference. It is 0.5 for equal distributions and 1 for
    disjoint ones (Lueckmann et al. 2021, Benchmarking simulation-based inference).

    Args:
        samples: ``(n, d)``.
        reference: ``(m, d)``; the longer set is cut to the shorter one's length.
        seed: Seed of the network and the folds.

    Raises:
        DependencyError: scikit-learn is not installed.
        ShapeError: The sets do not fit each other.
    """
    check_c2st()
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.model_selection import KFold, cross_val_score
    from sklearn.neural_network import MLPClassifier

    if samples.ndim != 2 or reference.ndim != 2 or samples.shape[1] != reference.shape[1]:
        raise ShapeError(
            f"c2st compares (n, d) with (m, d), got {tuple(samples.shape)} and "
            f"{tuple(reference.shape)}."
        )
    size = min(len(samples), len(reference))
    mean, std = reference.mean(0), reference.std(0)
    both = torch.cat([samples[:size], reference[:size]])
    data = ((both - mean) / std).detach().cpu().numpy()
    labels = np.repeat([0, 1], size)
    hidden = (10 * samples.shape[1],) * 2
    network = MLPClassifier(hidden, max_iter=1_000, solver="adam", random_state=seed)
    folds = KFold(n_splits=5, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # A classifier that has not converged is weaker; the score already shows that.
        warnings.simplefilter("ignore", ConvergenceWarning)
        accuracy = cross_val_score(network, data, labels, cv=folds, scoring="accuracy")
    return float(np.mean(accuracy))


def _scale(measured: Tensor) -> Tensor:
    """Returns each channel's largest magnitude ``(C,)``; 1 for a channel that is always zero."""
    largest = measured.abs().amax(-2)
    return torch.where(largest > 0, largest, torch.ones_like(largest))


def _check(simulated: Sequence[Tensor], measured: Sequence[Tensor]) -> None:
    if len(simulated) != len(measured) or not measured:
        raise ShapeError(
            f"there are {len(simulated)} simulated and {len(measured)} measured rollouts."
        )
    for index, (x, y) in enumerate(zip(simulated, measured, strict=True)):
        if y.ndim != 2 or x.shape[-2:] != y.shape or 0 in y.shape:
            raise ShapeError(
                f"rollout {index} was measured with shape {tuple(y.shape)} and simulated with "
                f"{tuple(x.shape)}; (T, C) and (..., T, C) are needed."
            )


def _check_ensemble(samples: Tensor, observation: Tensor) -> None:
    if samples.ndim == 0 or samples.shape[1:] != observation.shape or samples.shape[0] == 0:
        raise ShapeError(
            f"an ensemble for an observation of shape {tuple(observation.shape)} has one more "
            f"dimension in front, got {tuple(samples.shape)}."
        )
