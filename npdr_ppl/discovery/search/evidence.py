"""The probabilities of several hypotheses, given a recording.

Each segment's log density under each fitted hypothesis is computed with one scale of the
measurements and one share of independent measurements. Both are those of the hypothesis with the
smallest residuals. Evidence is the sum of the log densities, minus the penalty for the priors and
the number of parameters, plus the log of the prior probability.

The weights are pseudo-BMA+ (Yao, Vehtari, Simpson & Gelman 2018): the Bayesian bootstrap resamples
the evidence over blocks of segments. If two hypotheses differ only in a few segments by chance,
they share the probability.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.permutation_tests import block_sums
from npdr_ppl.discovery.search.settings import EVIDENCE

__all__ = ["closest", "evidence", "log_evidence", "weigh"]


def closest(hypotheses: Sequence[Hypothesis]) -> Hypothesis:
    """Returns the hypothesis with the least residuals, by their geometric mean over channels."""
    return min(hypotheses, key=lambda h: float(h.fit.scale.log().sum()))


def evidence(
    hypotheses: Sequence[Hypothesis], log_prior: Sequence[float], reference: Hypothesis
) -> Tensor:
    """Returns the log evidence of each hypothesis by block of segments, ``(H, blocks)``.

    Args:
        hypotheses: H fitted hypotheses.
        log_prior: Log of each one's prior probability.
        reference: The hypothesis whose residuals give the scale and the share.
    """
    scale, share = reference.fit.scale, reference.share
    rows = []
    for hypothesis, prior in zip(hypotheses, log_prior, strict=True):
        blocks = -share * block_sums(hypothesis.losses(scale)[:, None])[:, 0]
        rows.append(blocks + (prior - hypothesis.complexity) / len(blocks))
    return torch.stack(rows)


def log_evidence(current: Hypothesis, other: Hypothesis) -> float:
    """Returns the log evidence for another hypothesis than the current one.

    Args:
        current: The current one.
        other: The other one, along the same segments. The noise is what it leaves.
    """
    scale = other.fit.scale
    return other.share * float((current.losses(scale) - other.losses(scale)).sum())


def weigh(hypotheses: Sequence[Hypothesis], log_prior: Sequence[float]) -> list[float]:
    """Returns the probability of each hypothesis, assuming that one of them is true.

    Args:
        hypotheses: H fitted hypotheses.
        log_prior: Log of each one's prior probability, up to a constant.
    """
    rows = evidence(hypotheses, log_prior, closest(hypotheses))
    generator = torch.Generator().manual_seed(0)
    draws = torch.rand(
        EVIDENCE.num_resamplings, rows.shape[1], generator=generator, dtype=torch.float64
    )
    weights = -draws.clamp_min(1e-300).log()  # exponential, hence Dirichlet once normalised
    weights = weights / weights.mean(-1, keepdim=True)
    return (weights @ rows.mT).nan_to_num(-math.inf).softmax(-1).mean(0).tolist()
