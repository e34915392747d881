"""Changes by laws of force at one port, computed from few numbers per segment.

The change from a law of force is R v: the responses R to pulses of force, weighted by the law's
values v at the pulses. Let J be the derivatives by parameters and W = C^-½ the whitening of
:mod:`~npdr_ppl.discovery.screening.projection`. What remains of the change after the parameters
are refitted is

    W R v − W J u,     u = (Jᵀ C⁻¹ J + 1)⁻¹ Jᵀ C⁻¹ R v

In every segment, this is a combination of the P + d columns of (W R, W J), whatever the law is.
So the products with measurements are computed once per port. The score of a law then costs
products of P + d numbers per segment, instead of products of all measurements.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection, Scores

__all__ = ["ForceChange", "PulseChanges"]


class PulseChanges:
    """The changes that forces at one port can cause.

    Args:
        projection: The fitted hypothesis.
        responses: Change of the whitened measurements by each pulse, ``(S, N, P)``.
    """

    def __init__(self, projection: Projection, responses: Tensor) -> None:
        self._projection = projection
        whitened = projection.whitened(responses)
        residual = projection.whitened(projection.residual[..., None])
        #: The columns (W R, W J), (S, N, P + d).
        self.columns = torch.cat((whitened, projection.whitened_parameters), dim=-1)
        self._explained = projection.explained_by_segment(responses)  # (S, d, P)
        self._information = whitened.mT @ whitened  # (S, P, P)
        self._scores = (whitened.mT @ residual)[..., 0]  # (S, P)

    def weights(self, values: Tensor) -> Tensor:
        """Returns the weights (v, −u) of :attr:`columns`, ``(S, P + d, k)``.

        Args:
            values: The laws' values v at the pulses, ``(S, P, k)``.
        """
        refit = self._projection.refit((self._explained @ values).sum(0))
        return torch.cat((values, -refit.expand(len(values), -1, -1)), dim=1)

    def scores(self, values: Tensor) -> Scores:
        """Returns the same as :meth:`Projection.scores` of the changes, from ``(S, P, k)``."""
        explained = (self._explained @ values).sum(0)
        refit = self._projection.refit(explained)
        own = (values.mT @ (self._information @ values)).sum(0)
        by_segment = (values.mT @ self._scores[..., None])[..., 0]
        by_segment = by_segment - self._projection.parameter_scores @ refit
        return Scores(by_segment, own - explained.mT @ refit, own.diagonal())


@dataclass(frozen=True)
class ForceChange:
    """The change from a law of force.

    Attributes:
        pulses: The changes that forces at its port can cause.
        values: Its values at the pulses, ``(S, P, k)``.
    """

    pulses: PulseChanges
    values: Tensor
