"""Which sizes of a resonance are simulated."""

import itertools
import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.probes import Probe
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import SENSITIVITY

__all__ = ["at_telling_sizes"]


def at_telling_sizes(
    group: list[Probe],
    changed: Callable[[list[Probe]], list[Tensor]],
    projection: Projection | None,
) -> tuple[list[Probe], list[Tensor]]:
    """Returns the probes with the sizes that tell something, and their changes.

    Far from the frequencies of the motion, neighbouring resonances change it alike. Between two
    sizes that do not, the one in the middle is tried, and so on. With residuals, the part of the
    changes that initial states and parameters can imitate is removed first. Nothing is tried
    between two sizes whose changes are too large to explain the residuals, for example if a soft
    joint makes its servo unstable. It is assumed that those between them are too large as well.

    Args:
        group: Probes of resonances with all their sizes, which ascend.
        changed: Returns the changes of the whitened measurements by each run of probes.
        projection: The residuals to be explained; ``None`` if sizes only have to differ.
    """
    num = len(group[0].cases)
    found: list[dict[int, Tensor]] = [{} for _ in group]
    waiting = [sorted({*range(0, num, SENSITIVITY.resonance_stride), num - 1}) for _ in group]
    while any(waiting):
        asked = [probe.at(cases) for probe, cases in zip(group, waiting, strict=True) if cases]
        rows = iter(changed(asked))
        for k, (probe, cases) in enumerate(zip(group, waiting, strict=True)):
            if cases:
                found[k] |= dict(zip(cases, next(rows).split(len(probe.strengths)), strict=True))
                waiting[k] = _between_unlike(found[k], projection)
    chosen = [sorted(known) for known in found]
    return (
        [probe.at(cases) for probe, cases in zip(group, chosen, strict=True)],
        [torch.cat([known[k] for k in cases]) for known, cases in zip(found, chosen, strict=True)],
    )


def _between_unlike(known: Mapping[int, Tensor], projection: Projection | None) -> list[int]:
    """Returns the middles between neighbouring sizes that differ, unless both are too large.

    Args:
        known: Changes of the whitened measurements by sizes, ``(1, S, N)``: a resonance has one
            strength.
        projection: As for :func:`at_telling_sizes`.
    """
    cases = sorted(known)
    columns = torch.stack([known[case].sum(0) for case in cases], dim=-1)
    if projection is None:
        flat = columns.flatten(0, 1)
        products, scores, misfit = flat.mT @ flat, torch.zeros(len(cases)), math.inf
    else:
        found = projection.scores(columns)
        products, scores, misfit = found.information, found.score, projection.misfit
    middles = []
    for k, (one, other) in enumerate(itertools.pairwise(cases)):
        if other - one == 1:
            continue
        (a, ab), (_, b) = products[k : k + 2, k : k + 2].tolist()
        is_alike = ab >= SENSITIVITY.alike * math.sqrt(max(a * b, 1e-300))
        # Neither noise nor the residuals tell these apart.
        score = float(scores[k + 1] - scores[k])
        is_alike |= max(a + b - 2.0 * ab, abs(score)) < SENSITIVITY.least_difference
        # |r - m x|² exceeds |r|² for all m above 2 |r| / |x|. If no size between them is tried,
        # the larger one stands for those as well, with multiples m down to this one.
        least = SENSITIVITY.resonance_ratio ** (one - other)
        is_useless = not (a <= 4.0 * misfit or least**2 * b <= 4.0 * misfit)
        if not (is_alike or is_useless):
            middles.append((one + other) // 2)
    return middles
