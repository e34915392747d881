"""Stacking: the mixture of several posteriors that predicts segments best.

Yao, Vehtari, Simpson & Gelman (2018), *Using stacking to average Bayesian predictive
distributions*, https://arxiv.org/abs/1704.02030: with p_k(y_i) the predictive density of segment i
under posterior k, the weights are

    argmax_w  Σ_i log Σ_k w_k p_k(y_i),   w on the simplex          (their Eq. 4).
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.posterior.posterior import PosteriorBase

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["StackedPosterior", "Stacking", "mixture_elpd", "stack"]


NUM_DRAWS = 100
"""Number of equal draws that represent a density without draws; ArviZ's estimates need several."""


class StackedPosterior(PosteriorBase):
    """q(ξ | x_o) = Σ_k w_k q_k(ξ): posteriors of the same model and data, mixed.

    Attributes:
        bound: The model and its data.
        members: The posteriors q_k by label, those of weight zero included.
        shares: The weights w_k by label.
        densities: The components of all of them.
        weights: The components' weights.
    """

    def __init__(self, members: Mapping[str, PosteriorBase], shares: Mapping[str, float]) -> None:
        """Mixes posteriors.

        Args:
            members: Posteriors of one model on the same data, by label.
            shares: Their weights by label, with sum 1.

        Raises:
            DataError: There are none, a weight is missing or negative, the sum is not 1, or the
                posteriors are over different parameters.
        """
        if not members or set(members) != set(shares):
            raise DataError(
                f"Every posterior needs a weight: there are {', '.join(members) or 'none'} and "
                f"weights for {', '.join(shares) or 'none'}."
            )
        total = sum(shares.values())
        if min(shares.values()) < 0 or abs(total - 1) > 1e-6:
            raise DataError(f"Weights must not be negative and have sum 1, got {dict(shares)}.")
        sites = {tuple((s.name, s.shape) for s in q.prior.sites) for q in members.values()}
        if len(sites) > 1:
            raise DataError("Only posteriors over the same parameters can be mixed.")
        self.members = dict(members)
        self.shares = {label: share / total for label, share in shares.items()}
        parts = [q.weights * self.shares[label] for label, q in members.items()]
        super().__init__(
            next(iter(members.values())).bound,
            [density for q in members.values() for density in q.densities],
            torch.cat(parts),
        )

    @property
    def backend_name(self) -> str:
        """The labels and weights, e.g. ``"0.70 snpe-c + 0.30 snpe-a"``."""
        used = {label: share for label, share in self.shares.items() if share >= 0.005}
        return " + ".join(f"{share:.2f} {label}" for label, share in used.items())

    def sample_reference(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws ``(1, num_samples, d)`` of the mixture.

        A single chain, for which r̂ is not defined: the components are not repetitions of one
        method, and chains of equal length could not carry their weights.
        """
        return self.sample_mixture(num_samples, seed=seed)[None]


@dataclass(frozen=True)
class Stacking:
    """Weights of posteriors, and the differences of their elpd; see :func:`stack`.

    Attributes:
        weights: Weight by label; 0 for those without a finite density.
        difference: The best elpd minus each elpd, by label; not negative.
        standard_error: Standard error of that difference over segments, by label.
    """

    weights: dict[str, float]
    difference: dict[str, float]
    standard_error: dict[str, float]


def stack(pointwise: Mapping[str, NDArray[np.float64]]) -> Stacking:
    """Compares posteriors by their log predictive densities of the same segments.

    Args:
        pointwise: log p_k(y_i), ``(segments,)`` by label. A posterior with a value that is not
            finite excludes a recorded segment; it gets no weight and no difference.

    Raises:
        DataError: No posterior has finite densities.
    """
    finite = {label: v for label, v in pointwise.items() if len(v) and np.isfinite(v).all()}
    if not finite:
        raise DataError("No posterior gives the recorded segments a finite density.")
    weights = dict.fromkeys(pointwise, 0.0)
    if len(finite) == 1:
        (label,) = finite
        return Stacking(weights | {label: 1.0}, {label: 0.0}, {label: 0.0})
    table = _compared(finite)
    found = {label: max(0.0, float(table.loc[label, "weight"])) for label in finite}
    total = sum(found.values())
    return Stacking(
        weights | {label: weight / total for label, weight in found.items()},
        {label: abs(float(table.loc[label, "elpd_diff"])) for label in finite},
        {label: float(table.loc[label, "dse"]) for label in finite},
    )


def mixture_elpd(
    pointwise: Mapping[str, NDArray[np.float64]], weights: Mapping[str, float]
) -> NDArray[np.float64]:
    """Returns log Σ_k w_k p_k(y_i) of the mixture, ``(segments,)``; see :func:`stack`."""
    used = [label for label, weight in weights.items() if weight > 0]
    logs = torch.stack([torch.from_numpy(pointwise[label]) for label in used])
    shares = torch.tensor([weights[label] for label in used], dtype=torch.float64)
    return (logs + shares.log()[:, None]).logsumexp(0).numpy()


def _compared(pointwise: Mapping[str, NDArray[np.float64]]) -> "pd.DataFrame":
    """Returns ArviZ's comparison by given pointwise densities.

    ArviZ computes a leave-one-out density from the densities of many draws. Here the predictive
    densities are already known. Every draw that is passed to ArviZ therefore has the same density,
    which leave-one-out returns unchanged.

    ArviZ exponentiates the log densities, which underflow if segments have many measurements. The
    greatest value of each segment is therefore subtracted first. A common factor of all posteriors
    changes neither the weights nor a difference.
    """
    from npdr_ppl.arviz_module import compare, from_dict

    greatest = np.max(list(pointwise.values()), axis=0)
    data = {
        label: from_dict(
            {
                "posterior": {"draw_number": np.arange(NUM_DRAWS)[None]},
                "log_likelihood": {"segments": np.tile(values - greatest, (1, NUM_DRAWS, 1))},
            }
        )
        for label, values in pointwise.items()
    }
    with warnings.catch_warnings():
        # Of weights that cannot be smoothed, since they are all equal, and of densities that
        # underflow even so and weigh nothing, as they should.
        warnings.simplefilter("ignore")
        return compare(data)
