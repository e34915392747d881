"""Coordinates in which posteriors of physical parameters are close to normal.

A motion determines products and ratios of masses, lengths and gains. If several parameters occur
only in one product, the posterior is a ridge. The ridge is curved in the prior's reference
coordinates and straight in the parameters' logarithms. The posterior of a parameter about which a
recording says little is the prior, and that is normal in reference coordinates only.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.sampling_settings import SAMPLING_COORDINATES

__all__ = ["SamplingCoordinates"]


@dataclass(frozen=True)
class SamplingCoordinates:
    """Coordinates y of a prior: each parameter, its logarithm, or its reference coordinate.

    Priors whose sites are not independent scalars keep their reference coordinates.

    Attributes:
        prior: The prior.
        is_elementwise: Whether y is made of the parameters one by one.
        is_logarithm: Which coordinates are logarithms of parameters, ``(d,)``.
        is_reference: Which of them are reference coordinates, ``(d,)``.
        variance: Variance of y under the prior, ``(d,)``.
    """

    prior: Prior
    is_elementwise: bool
    is_logarithm: Tensor
    is_reference: Tensor
    variance: Tensor

    @classmethod
    def of(cls, prior: Prior, undetermined: Tensor | None = None) -> "SamplingCoordinates":
        """Chooses the coordinates of a prior.

        Logarithms are taken of parameters that cannot be close to zero, or whose logarithms are
        normal.

        Args:
            prior: The prior.
            undetermined: Mask of parameters that keep their reference coordinates, because a
                recording says little about them, ``(d,)``; none by default.
        """
        d = prior.num_parameters
        none, ones = torch.zeros(d, dtype=torch.bool), torch.ones(d, dtype=torch.float64)
        rest = cls(prior, False, none, ~none, ones)
        if any(site.shape.numel() != 1 for site in prior.sites):
            return rest
        ends = torch.stack(
            [
                torch.full((d,), sign * SAMPLING_COORDINATES.tail_coordinate)
                for sign in (-1.0, 0.0, 1.0)
            ]
        ).double()
        low, middle, high = _columns(prior, ends)
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
        is_far_from_zero = high < SAMPLING_COORDINATES.widest_ratio * low
        # Sites are in single precision.
        is_log_normal = torch.isclose(low * high, middle.square(), rtol=1e-4, atol=0.0)
        is_reference = none
        if undetermined is not None and prior.is_standard_normal:
            is_reference = undetermined
        is_logarithm = (low > 0.0) & (is_far_from_zero | is_log_normal) & ~is_reference
        raw = cls(prior, True, is_logarithm, is_reference, ones)
        return replace(raw, variance=raw.from_reference(z).var(0))

    def tensors(self) -> dict[str, Tensor]:
        """Returns the tensors from which, with the prior, the coordinates can be rebuilt."""
        return {
            "is_elementwise": torch.tensor(self.is_elementwise),
            "is_logarithm": self.is_logarithm,
            "is_reference": self.is_reference,
            "variance": self.variance,
        }

    @classmethod
    def of_tensors(cls, prior: Prior, tensors: Mapping[str, Tensor]) -> "SamplingCoordinates":
        """Rebuilds coordinates of a prior from :meth:`tensors`.

        Raises:
            DataError: They are of an earlier version.
        """
        if "is_reference" not in tensors:
            raise DataError("The posterior is of an earlier version of npdr_ppl; fit it again.")
        return cls(
            prior,
            bool(tensors["is_elementwise"]),
            tensors["is_logarithm"],
            tensors["is_reference"],
            tensors["variance"],
        )

    def from_reference(self, z: Tensor) -> Tensor:
        """Maps reference coordinates ``(n, d)`` to y."""
        z = z.double()
        if not self.is_elementwise:
            return z
        values = _columns(self.prior, z)
        y = torch.where(self.is_logarithm, values.clamp_min(1e-300).log(), values)
        return torch.where(self.is_reference, z, y)

    def to_reference(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Maps y ``(n, d)`` to reference coordinates; also returns which lie on the support.

        Points outside the support are mapped to the centre.
        """
        if not self.is_elementwise:
            return y, torch.ones(len(y), dtype=torch.bool)
        values = torch.where(self.is_logarithm, y.exp(), y)
        if bool(self.is_reference.any()):
            own = _columns(self.prior, torch.where(self.is_reference, y, 0.0))
            values = torch.where(self.is_reference, own, values)
        parameters = {
            site.name: values[:, k].reshape((-1, *site.shape))
            for k, site in enumerate(self.prior.sites)
        }
        inside = self.prior.on_support(parameters)
        kept = {name: value[inside] for name, value in parameters.items()}
        z = torch.zeros_like(y)
        if bool(inside.any()):
            found = self.prior.to_reference(kept).double()
            z[inside] = torch.where(self.is_reference, y[inside], found)
        return z, inside

    def log_jacobian(self, z: Tensor, y: Tensor) -> Tensor:
        """Returns log |∂y/∂z|, ``(n,)``."""
        if not self.is_elementwise:
            return torch.zeros(len(z), dtype=torch.float64)
        rest = torch.where(self.is_reference, 0.0, z.double())
        of_values = self.prior.log_jacobian(rest).double() - self._left_out
        return of_values - (y * self.is_logarithm).sum(-1)

    @cached_property
    def _left_out(self) -> Tensor:
        """Σ log |∂θ/∂z| of the parameters with reference coordinates, where these are zero."""
        middle = self.prior.to_parameters(torch.zeros(1, len(self.variance)).double())
        total = torch.zeros((), dtype=torch.float64)
        for site, is_left_out in zip(self.prior.sites, self.is_reference, strict=True):
            if is_left_out:
                density = self.prior.distributions[site.name].log_prob(middle[site.name])
                total = total - 0.5 * math.log(2.0 * math.pi) - density.double().sum()
        return total

    def slope(self, z: Tensor) -> Tensor:
        """Returns ∂y/∂z of each coordinate at one point ``(d,)``, shape ``(d,)``."""
        width = 1e-4
        both = self.from_reference(torch.stack((z + width, z - width)))
        return (both[0] - both[1]) / (2.0 * width)


def _columns(prior: Prior, z: Tensor) -> Tensor:
    """Returns the values of scalar sites side by side, ``(n, d)`` float64."""
    values: Mapping[str, Tensor] = prior.to_parameters(z)
    return torch.stack([values[site.name].double().reshape(len(z)) for site in prior.sites], -1)
