"""An embedding that keeps what a recording says about the parameters near its closest fit."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.embeddings.base import Embedding, check_trajectory
from npdr_ppl.language.inputs import Inputs

__all__ = ["Score"]


@dataclass(frozen=True, eq=False, repr=False)
class Score(Embedding):
    """The gradient of a Gaussian log likelihood by the parameters, at one point.

    With the simulation μ, its derivative J and the covariance C of what it leaves, all at the
    point of expansion, the features of a trajectory x are the d numbers t(x) = Jᵀ C⁻¹ (x − μ): no
    d numbers hold more Fisher information about the parameters there. Far from that point
    trajectories are unlike a linear model's, so each is divided by its standard deviation
    √(Jᵀ C⁻¹ J) and compressed by asinh, which loses nothing.

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
