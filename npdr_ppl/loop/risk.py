"""The objective of a policy search over domains: the mean return, or that of the worst domains.

Failed simulations have a return of −∞.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError

__all__ = ["MeanReturn", "Risk", "TailMean"]


class Risk(Protocol):
    """Reduces the returns in many domains to one number per policy."""

    def __call__(self, returns: Tensor) -> Tensor:
        """Returns one number per policy.

        Args:
            returns: Mean return of each policy in each domain, ``(..., D)``.

        Returns:
            Numbers to maximise, ``(...)``, in float64.
        """
        ...


@dataclass(frozen=True)
class MeanReturn:
    """The mean over all domains: good domains can compensate for domains where a policy fails."""

    def __call__(self, returns: Tensor) -> Tensor:
        """Returns the mean; see :class:`Risk`."""
        return _worst_first(returns).mean(-1)


@dataclass(frozen=True)
class TailMean:
    """The mean over the worst share α of the domains, the conditional value at risk CVaR_α.

    With returns in ascending order R₁ ≤ … ≤ R_D and k = α D,

        CVaR_α = (1/k) (R₁ + … + R_⌊k⌋ + (k − ⌊k⌋) R_⌊k⌋₊₁).

    Args:
        share: α, above 0 and at most 1; 1 gives the mean over all domains.

    References: Chow and Ghavamzadeh, Algorithms for CVaR Optimization in MDPs, NeurIPS 2014;
    Rajeswaran et al., EPOpt: Learning Robust Neural Network Policies Using Model Ensembles, ICLR
    2017, which trains on the worst tenth of an ensemble of simulators.
    """

    share: float = 0.2

    def __post_init__(self) -> None:
        """Checks the share.

        Raises:
            ModelError: It is out of range.
        """
        if not 0.0 < self.share <= 1.0:
            raise ModelError(f"share must be above 0 and at most 1; got {self.share}.")

    def __call__(self, returns: Tensor) -> Tensor:
        """Returns the mean of the worst share; see :class:`Risk`."""
        ordered = _worst_first(returns)
        number = self.share * ordered.shape[-1]
        whole = min(math.floor(number), ordered.shape[-1])
        # A weight of 0 is skipped, because 0 times −∞ is NaN.
        total = ordered[..., :whole].sum(-1)
        if whole < ordered.shape[-1] and number > whole:
            total = total + (number - whole) * ordered[..., whole]
        return total / number


def _worst_first(returns: Tensor) -> Tensor:
    """Returns float64 returns in ascending order, with NaN first, as −∞."""
    return torch.nan_to_num(returns.double(), nan=-math.inf).sort(-1).values
