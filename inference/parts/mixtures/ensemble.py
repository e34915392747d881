"""The posterior of an ensemble: the equal mixture of its members."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density

__all__ = ["Mixture"]


class Mixture(Density):
    """The equal mixture q(z) = (1 / M) sum_m q_m(z).

    Args:
        members: The densities q_m.
    """

    def __init__(self, members: Sequence[Density]) -> None:
        self._members = list(members)

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)``, as equally from all members as possible, in random order."""
        share, rest = divmod(num_samples, len(self._members))
        draws = [q.sample(share + (k < rest)) for k, q in enumerate(self._members)]
        return torch.cat(draws)[torch.randperm(num_samples)]

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``."""
        values = torch.stack([q.log_prob(z) for q in self._members])
        return values.logsumexp(0) - math.log(len(self._members))
