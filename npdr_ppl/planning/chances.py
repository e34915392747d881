"""The chance that discovery names the right cause, given the separations of a recording.

If cause a is true, block k of the recording adds d_k²/2 + d_k ε to the log evidence of a against
b, where d_k is the separation along the block and ε is standard normal. Discovery resamples the
blocks with exponential weights (:mod:`npdr_ppl.discovery.search.evidence`), and names a cause with
a probability of at least 0.9. Both are simulated here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.planning.settings import PLANNING

__all__ = ["Chance", "chance_of_naming"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Chance:
    """What a search with the further recording is expected to say.

    Attributes:
        right: Probability that it names the true cause.
        wrong: Probability that it names another one.
    """

    right: float
    wrong: float


def chance_of_naming(
    probabilities: Sequence[float], squares: Mapping[tuple[int, int], Array], seed: int = 0
) -> Chance:
    """Returns the chance that one cause is named, averaged over which one is true.

    The noise of different pairs is drawn independently.

    Args:
        probabilities: Probability of each cause after the recordings so far, ``(n,)``.
        squares: Squared separation d_k² of b from a by block, ``(blocks,)``, for every pair
            ``(a, b)``.
        seed: Seed of the noise and of the weights.
    """
    likely = np.asarray(probabilities, dtype=np.float64)
    likely = likely / likely.sum()
    generator = np.random.default_rng(seed)
    confidence, right, wrong = DiscoveryOptions().confidence, 0.0, 0.0
    num_blocks = len(next(iter(squares.values())))
    weights = generator.exponential(size=(num_blocks, PLANNING.num_resamplings))
    weights /= weights.mean(0)
    for a in range(len(likely)):
        odds = np.zeros((PLANNING.num_datasets, PLANNING.num_resamplings, len(likely)))
        for b in range(len(likely)):
            if b == a:
                continue
            apart = squares[a, b]
            noise = generator.standard_normal((PLANNING.num_datasets, num_blocks))
            evidence = (0.5 * apart + np.sqrt(apart) * noise) @ weights
            odds[..., b] = np.log(likely[b] / likely[a]) - evidence
        odds = np.exp(odds - odds.max(-1, keepdims=True))
        found = (odds / odds.sum(-1, keepdims=True)).mean(1)  # (datasets, n)
        is_named = found >= confidence
        right += likely[a] * float(is_named[:, a].mean())
        wrong += likely[a] * float(np.delete(is_named, a, axis=1).any(-1).mean())
    return Chance(float(right), float(wrong))
