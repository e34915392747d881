r"""Reference coordinates of one distribution: a real vector z in which the prior is N(0, I).

For a scalar ξ with distribution function F,  z = Φ⁻¹(F(ξ)),  ξ = F⁻¹(Φ(z)).  Transformed and
multivariate normal distributions use their own construction from normals instead. Any other
distribution is mapped to its unconstrained space. Its prior in z is then not N(0, I), and
:attr:`ReferenceMap.is_standard_normal` is false.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from pyro.distributions.torch_distribution import ExpandedDistribution
from scipy import special
from torch import Tensor, distributions
from torch.distributions import biject_to, constraints
from torch.distributions.transforms import ComposeTransform

__all__ = ["ReferenceMap", "reference_map"]

# Float64 distinguishes Φ(±8.2) from 0 and 1. A half-normal distribution has its quantiles half-way
# between a probability and 1, which are distinguished up to Φ(8.1).
_MAX_Z = 8.1
# Torch has no quantile function for these distributions, but scipy has.
_SCIPY_QUANTILES = (distributions.Gamma, distributions.Beta)


class ReferenceMap(ABC):
    """Bijection between reference coordinates and the support of one distribution.

    Attributes:
        event_shape: Shape of z for one draw. It differs from the draw's own shape if the support
            is curved, e.g. a simplex.
        is_standard_normal: Whether z is N(0, I) under the distribution.
    """

    event_shape: torch.Size
    is_standard_normal: bool = True

    @abstractmethod
    def __call__(self, z: Tensor) -> Tensor:
        """Maps z, ``batch_shape + event_shape``, to values on the support."""

    @abstractmethod
    def inverse(self, value: Tensor) -> Tensor:
        """Maps values to z."""

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density of z under the distribution, of the batch shape."""
        log_prob = -0.5 * (z.square() + math.log(2 * math.pi))
        return _sum_rightmost(log_prob, len(self.event_shape))


class _Normal(ReferenceMap):
    def __init__(self, distribution: distributions.Normal) -> None:
        self.distribution = distribution
        self.event_shape = torch.Size()

    def __call__(self, z: Tensor) -> Tensor:
        return self.distribution.loc + self.distribution.scale * z

    def inverse(self, value: Tensor) -> Tensor:
        return (value - self.distribution.loc) / self.distribution.scale


class _MultivariateNormal(ReferenceMap):
    def __init__(self, distribution: distributions.MultivariateNormal) -> None:
        self.distribution = distribution
        self.event_shape = distribution.event_shape

    def __call__(self, z: Tensor) -> Tensor:
        factor = self.distribution.scale_tril.to(z.dtype)
        return self.distribution.loc + (factor @ z[..., None])[..., 0]

    def inverse(self, value: Tensor) -> Tensor:
        centred = (value - self.distribution.loc)[..., None]
        factor = self.distribution.scale_tril.to(centred.dtype)
        return torch.linalg.solve_triangular(factor, centred, upper=False)[..., 0]


class _Quantile(ReferenceMap):
    """z = Φ⁻¹(F(ξ)) for a scalar distribution with F and F⁻¹."""

    def __init__(self, distribution: distributions.Distribution) -> None:
        self.distribution = distribution
        self.event_shape = torch.Size()

    def __call__(self, z: Tensor) -> Tensor:
        # In float32, Φ(5.4) is already 1, where many quantiles are infinite.
        probability = torch.special.ndtr(z.double().clamp(-_MAX_Z, _MAX_Z))
        return quantile(self.distribution, probability).to(z.dtype)

    def inverse(self, value: Tensor) -> Tensor:
        probability = _cdf(self.distribution, value.double())
        return torch.special.ndtri(probability).clamp(-_MAX_Z, _MAX_Z).to(value.dtype)


class _Transformed(ReferenceMap):
    def __init__(
        self, distribution: distributions.TransformedDistribution, transform: ComposeTransform
    ) -> None:
        self.base = reference_map(distribution.base_dist)
        self.transform = transform
        self.event_shape = self.base.event_shape
        self.is_standard_normal = self.base.is_standard_normal
        self.dtype = _own_dtype(distribution.base_dist)

    def __call__(self, z: Tensor) -> Tensor:
        # A transform's own matrices have the model's precision and do not mix with float64.
        value: Any = self.transform(self.base(z).to(self.dtype))
        return value

    def inverse(self, value: Tensor) -> Tensor:
        base: Any = self.transform.inv(value.to(self.dtype))
        return self.base.inverse(base)

    def log_prob(self, z: Tensor) -> Tensor:
        return self.base.log_prob(z)


class _Independent(ReferenceMap):
    def __init__(self, base: ReferenceMap, inner_shape: torch.Size) -> None:
        self.base = base
        self.event_shape = inner_shape + base.event_shape
        self.is_standard_normal = base.is_standard_normal
        self.num_inner = len(inner_shape)

    def log_prob(self, z: Tensor) -> Tensor:
        return _sum_rightmost(self.base.log_prob(z), self.num_inner)

    def __call__(self, z: Tensor) -> Tensor:
        return self.base(z)

    def inverse(self, value: Tensor) -> Tensor:
        return self.base.inverse(value)


class _Unconstrained(ReferenceMap):
    """z = biject_to(support)⁻¹(ξ): real, but not standard normal."""

    is_standard_normal = False

    def __init__(self, distribution: distributions.Distribution) -> None:
        self.distribution = distribution
        support = distribution.support
        if isinstance(distribution, distributions.VonMises):
            # Torch gives the real line as its support, but the density integrates to 1 per turn.
            support = constraints.interval(-math.pi, math.pi)
        self.transform = biject_to(support)
        shape = self.transform.inverse_shape(distribution.batch_shape + distribution.event_shape)
        self.event_shape = shape[len(distribution.batch_shape) :]

    def __call__(self, z: Tensor) -> Tensor:
        return self.transform(z)

    def inverse(self, value: Tensor) -> Tensor:
        return self.transform.inv(value)

    def log_prob(self, z: Tensor) -> Tensor:
        value = self.transform(z)
        jacobian = self.transform.log_abs_det_jacobian(z, value)
        jacobian = _sum_rightmost(jacobian, jacobian.dim() - len(self.distribution.batch_shape))
        return self.distribution.log_prob(value) + jacobian


def reference_map(distribution: distributions.Distribution) -> ReferenceMap:
    """Returns the reference coordinates of a continuous distribution."""
    if isinstance(distribution, ExpandedDistribution):
        return reference_map(distribution.base_dist)
    if isinstance(distribution, distributions.Independent):
        base = reference_map(distribution.base_dist)
        num = distribution.reinterpreted_batch_ndims
        inner = distribution.base_dist.batch_shape[-num:] if num else torch.Size()
        return _Independent(base, inner)
    if isinstance(distribution, distributions.TransformedDistribution):
        transform = ComposeTransform(distribution.transforms)
        # A half-normal takes the absolute value, which has no inverse; it uses quantiles.
        if transform.bijective:
            return _Transformed(distribution, transform)
    if isinstance(distribution, distributions.Normal):
        return _Normal(distribution)
    if isinstance(distribution, distributions.MultivariateNormal):
        return _MultivariateNormal(distribution)
    if distribution.event_shape == torch.Size() and _has_quantiles(distribution):
        return _Quantile(distribution)
    return _Unconstrained(distribution)


def _own_dtype(distribution: Any) -> torch.dtype:
    """Returns the floating-point type in which a distribution samples."""
    while not distribution.arg_constraints and hasattr(distribution, "base_dist"):
        distribution = distribution.base_dist
    values = [getattr(distribution, name) for name in distribution.arg_constraints]
    dtypes = [value.dtype for value in values if isinstance(value, Tensor)]
    return dtypes[0] if dtypes else torch.get_default_dtype()


def _sum_rightmost(value: Tensor, num: int) -> Tensor:
    return value.flatten(-num).sum(-1) if num else value


def _has_quantiles(distribution: distributions.Distribution) -> bool:
    if isinstance(distribution, _SCIPY_QUANTILES):
        return True
    try:
        with torch.no_grad():
            probability = torch.full(distribution.batch_shape, 0.5, dtype=torch.float64)
            distribution.cdf(distribution.icdf(probability))
    except NotImplementedError:
        return False
    return True


def quantile(distribution: distributions.Distribution, probability: Tensor) -> Tensor:
    """Returns quantiles; torch lacks those of the gamma and beta distributions."""
    if isinstance(distribution, distributions.Gamma):
        unit = special.gammaincinv(
            distribution.concentration.detach().cpu().numpy(), probability.cpu().numpy()
        )
        return torch.as_tensor(unit, device=probability.device) / distribution.rate
    if isinstance(distribution, distributions.Beta):
        a = distribution.concentration1.detach().cpu().numpy()
        b = distribution.concentration0.detach().cpu().numpy()
        value = special.betaincinv(a, b, probability.cpu().numpy())
        return torch.as_tensor(value, device=probability.device)
    return distribution.icdf(probability)


def _cdf(distribution: distributions.Distribution, value: Tensor) -> Tensor:
    """Returns the distribution function; torch lacks the beta distribution's."""
    if isinstance(distribution, distributions.Beta):
        a = distribution.concentration1.detach().cpu().numpy()
        b = distribution.concentration0.detach().cpu().numpy()
        probability = special.betainc(a, b, value.cpu().numpy())
        return torch.as_tensor(probability, device=value.device)
    return distribution.cdf(value)
