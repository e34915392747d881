"""Coordinates in which posteriors of physical parameters are close to normal.

A motion determines products and ratios of masses, lengths and gains. If several parameters occur
only in one product, the posterior is a ridge. The ridge is curved in the prior's reference
coordinates and straight in the parameters' logarithms.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.settings import SAMPLING_COORDINATES

__all__ = ["SamplingCoordinates"]


@dataclass(frozen=True)
class SamplingCoordinates:
    """Coordinates y of a prior: each parameter, or its logarithm if it cannot be close to zero.

    Priors whose sites are not independent scalars keep their reference coordinates.

    Attributes:
        prior: The prior.
        is_elementwise: Whether y is the parameters or their logarithms.
        is_logarithm: Which of them are logarithms, ``(d,)``.
        variance: Variance of y under the prior, ``(d,)``.
    """

    prior: Prior
    is_elementwise: bool
    is_logarithm: Tensor
    variance: Tensor

    @classmethod
    def of(cls, prior: Prior) -> "SamplingCoordinates":
        """Chooses the coordinates of a prior."""
        d = prior.num_parameters
        none = torch.zeros(d, dtype=torch.bool)
        rest = cls(prior, False, none, torch.ones(d, dtype=torch.float64))
        if any(site.shape.numel() != 1 for site in prior.sites):
            return rest
        ends = torch.stack(
            [
                torch.full((d,), sign * SAMPLING_COORDINATES.tail_coordinate)
                for sign in (-1.0, 0.0, 1.0)
            ]
        ).double()
        low, _, high = _columns(prior, ends)
        generator = torch.Generator().manual_seed(0)
        z = torch.randn(
            SAMPLING_COORDINATES.num_prior_draws, d, generator=generator, dtype=torch.float64
        )
        # If a site depends on others, its values change with theirs.
        alone = torch.where(
            torch.eye(d, dtype=torch.bool), SAMPLING_COORDINATES.tail_coordinate, 0.0
        ).double()
        if not torch.allclose(_columns(prior, alone).diagonal(), high):
            return rest
        is_logarithm = (low > 0.0) & (high < SAMPLING_COORDINATES.widest_ratio * low)
        raw = cls(prior, True, is_logarithm, torch.ones(d, dtype=torch.float64))
        variance = raw.from_reference(z).var(0)
        return cls(prior, True, is_logarithm, variance)

    def from_reference(self, z: Tensor) -> Tensor:
        """Maps reference coordinates ``(n, d)`` to y."""
        if not self.is_elementwise:
            return z.double()
        values = _columns(self.prior, z.double())
        return torch.where(self.is_logarithm, values.clamp_min(1e-300).log(), values)

    def to_reference(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Maps y ``(n, d)`` to reference coordinates; also returns which lie on the support.

        Points outside the support are mapped to the centre.
        """
        if not self.is_elementwise:
            return y, torch.ones(len(y), dtype=torch.bool)
        values = torch.where(self.is_logarithm, y.exp(), y)
        parameters = {
            site.name: values[:, k].reshape((-1, *site.shape))
            for k, site in enumerate(self.prior.sites)
        }
        inside = self.prior.on_support(parameters)
        kept = {name: value[inside] for name, value in parameters.items()}
        z = torch.zeros_like(y)
        if bool(inside.any()):
            z[inside] = self.prior.to_reference(kept).double()
        return z, inside

    def log_jacobian(self, z: Tensor, y: Tensor) -> Tensor:
        """Returns log |∂y/∂z|, ``(n,)``."""
        if not self.is_elementwise:
            return torch.zeros(len(z), dtype=torch.float64)
        return self.prior.log_jacobian(z).double() - (y * self.is_logarithm).sum(-1)

    def slope(self, z: Tensor) -> Tensor:
        """Returns ∂y/∂z of each coordinate at one point ``(d,)``, shape ``(d,)``."""
        width = 1e-4
        both = self.from_reference(torch.stack((z + width, z - width)))
        return (both[0] - both[1]) / (2.0 * width)


def _columns(prior: Prior, z: Tensor) -> Tensor:
    """Returns the values of scalar sites side by side, ``(n, d)`` float64."""
    values: Mapping[str, Tensor] = prior.to_parameters(z)
    return torch.stack([values[site.name].double().reshape(len(z)) for site in prior.sites], -1)
