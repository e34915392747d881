"""Whether a fit needs no search for a better one elsewhere in the prior.

A search simulates hundreds of draws of the prior. It is needed where the misfit has several local
minima, as for a pendulum that swings freely. Behind servos, motion changes almost in proportion to
masses, dampings and frictions, and a fit from any point ends at the same parameters.

With residuals r and derivatives J in the prior's middle, residuals at a distance Δ are
r − J Δ + e. Draws of the prior show how large the error e of this linear prediction is. Where it
is below ¼ |J Δ| for all draws, residuals at two opposite points differ by at least three quarters
of what is predicted. A parameter with little influence beside the others can still have several
minima. So a model whose laws declare them, such as backlash, is always searched.
"""

import torch

from npdr_ppl.discovery.search.settings import BASE_FIT
from npdr_ppl.preparation.sampling_coordinates import SamplingCoordinates
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.randomness import seeded

__all__ = ["has_single_minimum"]


def has_single_minimum(segments: SegmentModel, *, seed: int) -> bool:
    """Returns whether all draws of the prior change simulations nearly in proportion.

    ``False`` if the misfit has local minima along a parameter of an effect of the model.

    Args:
        segments: The model along the recording.
        seed: Seed of the draws.
    """
    if bool(segments.coordinates_with_minima.any()):
        return False
    middle = torch.zeros(segments.prior.num_parameters, dtype=torch.float64)
    offsets = segments.no_offsets
    scale = segments.scale_of(middle, offsets)
    if not bool(scale.isfinite().all()):
        return False
    now = segments.linearise(middle, offsets, scale, is_rough=True)
    if not now.is_finite:
        return False
    with seeded(seed, "single minimum"):
        z = segments.prior.sample(BASE_FIT.num_linear_draws)
    space = SamplingCoordinates.of(segments.prior)
    slope = space.slope(middle).clamp_min(1e-12)
    moved = (space.from_reference(z) - space.from_reference(middle[None])) / slope
    predicted = torch.einsum("snd,bd->bsn", now.by_parameters, moved)
    missed = segments.residuals(z, offsets[None], scale) - now.residual + predicted
    error, change = (part.flatten(1).norm(dim=-1) for part in (missed, predicted))
    return bool((error < BASE_FIT.largest_linear_error * change).all())
