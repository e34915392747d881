"""Markov chain Monte Carlo with an ensemble: steps of a walker are made from other walkers.

One sweep moves each half of the walkers in turn, with the other half fixed (Foreman-Mackey et al.
2013). Three moves take turns: a small difference of two walkers, one of random length
(differential evolution; ter Braak 2006), and the stretch of Goodman & Weare (2010). They adapt to
the scales and correlations of the density and have no step size to tune. A whole half moves in one
batch.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["ensemble_draws"]

STRETCH = 2.0
"""Greatest factor of a stretch; its inverse is the smallest (Goodman & Weare 2010)."""

DIFFERENCES = (0.2, 1.2)
"""Least and greatest factor of a difference, in units of 2.38/√(2d), which is optimal for normal
densities (ter Braak 2006). Smaller ones suit bent densities."""

SMALL_DIFFERENCE = 0.3
"""Factor of the small difference."""


def ensemble_draws(
    log_density: Callable[[Tensor], Tensor],
    walkers: Tensor,
    *,
    sweeps: int,
    interval: int,
    generator: torch.Generator,
) -> Tensor:
    """Moves walkers, and returns their positions from the second half of the sweeps.

    Args:
        log_density: Maps points ``(n, d)`` to log densities up to a constant, ``(n,)``; −∞ outside
            the support.
        walkers: First positions, ``(W, d)`` in float64, distributed roughly like the density.
        sweeps: Number of sweeps; each costs W evaluations.
        interval: Sweeps between positions that are returned, counted back from the last one.
        generator: Source of all randomness.

    Returns:
        The positions, ``(k W, d)``.
    """
    walkers, log_values = walkers.clone(), log_density(walkers)
    num, d = walkers.shape
    kept = []
    for sweep in range(1, sweeps + 1):
        order = torch.randperm(num, generator=generator)
        for moving, fixed in ((order[::2], order[1::2]), (order[1::2], order[::2])):
            size = len(moving)
            first, second = (
                walkers[fixed[torch.randint(len(fixed), (size,), generator=generator)]]
                for _ in range(2)
            )
            uniform = torch.rand(size, 1, generator=generator, dtype=torch.float64)
            correction = 0.0
            if sweep % 3 == 0:
                factor = ((STRETCH - 1.0) * uniform + 1.0).square() / STRETCH
                proposed = first + factor * (walkers[moving] - first)
                correction = (d - 1) * factor[:, 0].log()
            else:
                least, greatest = DIFFERENCES
                factor = (least + (greatest - least) * uniform) * 2.38 / math.sqrt(2.0 * d)
                if sweep % 3 == 1:
                    factor = torch.full_like(uniform, SMALL_DIFFERENCE)
                proposed = walkers[moving] + factor * (first - second)
            values = log_density(proposed)
            threshold = torch.rand(size, generator=generator, dtype=torch.float64).log()
            is_accepted = threshold < values - log_values[moving] + correction
            walkers[moving[is_accepted]] = proposed[is_accepted]
            log_values[moving[is_accepted]] = values[is_accepted]
        if 2 * sweep > sweeps and (sweeps - sweep) % interval == 0:
            kept.append(walkers.clone())
    return torch.cat(kept)
