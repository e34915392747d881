"""A weighted mixture of densities over domain parameters: draws, density, predictions."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.errors import ShapeError
from npdr_ppl.inference.base import Density
from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.binding import BoundModel
from npdr_ppl.randomness import seeded

__all__ = ["DensityMixture"]

ROUNDING = 1e-9
"""Rounding error that is allowed when a number of draws is compared with an integer."""


class DensityMixture(ABC):
    """q(ξ | x_o) = Σ_m w_m q_m(ξ): a weighted mixture of densities.

    Attributes:
        bound: The model and its data.
        densities: The components q_m, in reference coordinates.
        weights: Their weights w_m, ``(components,)`` float64 with sum 1.
    """

    def __init__(
        self, bound: BoundModel, densities: Sequence[Density], weights: Tensor | None = None
    ) -> None:
        """Makes the mixture; equal weights if none are given."""
        self.bound = bound
        self.densities = tuple(densities)
        if weights is None:
            weights = torch.ones(len(self.densities), dtype=torch.float64) / len(self.densities)
        self.weights = weights

    @property
    @abstractmethod
    def backend_name(self) -> str:
        """Name of the backend, or of the mixture of backends, that made it."""

    @abstractmethod
    def sample_reference(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Returns draws ``(chains, num_samples, d)``; ArviZ treats each member as a chain."""

    @property
    def prior(self) -> Prior:
        """The prior of the model."""
        return self.bound.prior

    def checks(self) -> dict[str, Any]:
        """Returns checks of estimator and model that do not use the draws; empty without any."""
        return {}

    def sample(self, num_samples: int, *, seed: int = 0) -> dict[str, Tensor]:
        """Draws domain parameters.

        Args:
            num_samples: Number of draws n.
            seed: Seed of the draws.

        Returns:
            Values ``(n,) + site.shape`` by site name, in the model's units; all lie on the
            prior's support.
        """
        return self.prior.to_parameters(self.sample_mixture(num_samples, seed=seed))

    def sample_mixture(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws from the mixture in reference coordinates, ``(num_samples, d)``.

        Interleaved, so that any leading part of the draws has the components in proportion to
        their weights: the j-th draw of component m is due at (j + 1/2) / w_m.
        """
        draws, due = [], []
        for member, (density, weight) in enumerate(
            zip(self.densities, self.weights.tolist(), strict=True)
        ):
            share = math.ceil(num_samples * weight - ROUNDING)
            if share < 1:
                continue
            with seeded(seed, "posterior", member):
                draws.append(density.sample(share).cpu())
            due.append((torch.arange(share, dtype=torch.float64) + 0.5) / weight)
        order = torch.cat(due).argsort(stable=True)
        return torch.cat(draws)[order[:num_samples]]

    def log_prob(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns log q(ξ | x_o), ``(n,)``, at values ``(n,) + site.shape`` by site name.

        Raises:
            ShapeError: A site is missing or has the wrong shape.
        """
        for site in self.prior.sites:
            value = parameters.get(site.name)
            if value is None or value.shape[1:] != site.shape:
                came = "nothing" if value is None else tuple(value.shape)
                raise ShapeError(
                    f"log_prob needs {site.name} with shape (n, *{tuple(site.shape)}), got {came}."
                )
        return self.log_prob_reference(self.prior.to_reference(dict(parameters)))

    def log_prob_reference(self, z: Tensor) -> Tensor:
        """Returns log q(ξ(z) | x_o), ``(n,)``, the density over ξ, at points ``(n, d)``."""
        with torch.no_grad():
            members = torch.stack([member.log_prob(z).double().cpu() for member in self.densities])
        # A component whose density is not a number contributes none to the mixture.
        members = members.where(~members.isnan(), -torch.inf) + self.weights.log()[:, None]
        return members.logsumexp(0) - self.prior.log_jacobian(z)

    def most_likely(self, num_samples: int = 10_000, *, seed: int = 0) -> dict[str, Tensor]:
        """Returns the draw of greatest density, of ``num_samples`` (``argmax`` in Algorithm 1)."""
        z = self.sample_mixture(num_samples, seed=seed)
        best = z[self.log_prob_reference(z).argmax()][None]
        return {name: value[0] for name, value in self.prior.to_parameters(best).items()}

    def predict(self, num_samples: int = 200, *, seed: int = 0) -> dict[str, Tensor]:
        """Simulates posterior draws: the posterior predictive, by black-box site.

        Returns:
            Outputs ``(num_samples,) + plates + event``.
        """
        z = self.sample_mixture(num_samples, seed=seed)
        with seeded(seed, "predict"):
            return self.prior.execute(z)
