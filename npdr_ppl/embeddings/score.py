"""An embedding that keeps the information on the parameters near the best fit."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.embeddings.base import Embedding, check_trajectory
from npdr_ppl.language.inputs import Inputs

__all__ = ["Score"]


@dataclass(frozen=True, eq=False, repr=False)
class Score(Embedding):
    """The gradient of a Gaussian log likelihood with respect to the parameters, at one point.

    Let μ be the simulation, J its derivative and C the covariance of the residuals, all at the
    point of expansion. The features of a trajectory x are the d numbers t(x) = Jᵀ C⁻¹ (x − μ). No
    d numbers hold more Fisher information about the parameters at this point. Far from it the
    linear model does not hold. Each number is therefore divided by its standard deviation √(Jᵀ C⁻¹
    J) and compressed by asinh, which loses no information.

    Attributes:
        mean: μ, ``(S, K, C)``.
        weights: The columns of C⁻¹ J, ``(S, K, C, d)``, zero at padded steps.
        deviation: Standard deviation of t, ``(d,)``.

    References:
        J. Alsing and B. Wandelt, Generalized massive optimal data compression, 2018, eq. 10.
    """

    mean: Tensor
    weights: Tensor
    deviation: Tensor

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the compressed score, ``(B, d)``."""
        check_trajectory(trajectory, inputs)
        difference = (trajectory - self.mean.to(trajectory)).double()
        score = torch.einsum("bskc,skcd->bd", difference, self.weights.to(difference))
        return torch.asinh(score / self.deviation.to(score))

    def __repr__(self) -> str:
        return f"Score({self.weights.shape[-1]} parameters)"
