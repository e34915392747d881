"""Scalar sites that do not depend on each other, evaluated without runs of their program.

A run of a Pyro program takes milliseconds for a handful of sites, and a posterior asks for the
prior thousands of times.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.language.latent_sites import LatentSite
from npdr_ppl.language.program_runs import unvalidated
from npdr_ppl.language.reference import reference_map

__all__ = ["IndependentSites"]


class IndependentSites:
    """The prior of scalar sites, each with a distribution of its own.

    Args:
        sites: The sites.
        distributions: Their distributions by name.
    """

    def __init__(self, sites: Sequence[LatentSite], distributions: Mapping[str, Any]) -> None:
        self.sites = tuple(sites)
        self.distributions = [distributions[site.name] for site in sites]
        self.maps = [reference_map(distribution) for distribution in self.distributions]

    @classmethod
    @unvalidated()
    def of(
        cls, sites: Sequence[LatentSite], distributions: Mapping[str, Any], trace: Any
    ) -> "IndependentSites | None":
        """Returns the sites of a program; ``None`` if they are no independent scalars.

        The reference coordinates have to be standard normal.

        Args:
            sites: The latent sites.
            distributions: Their distributions in another run, by name.
            trace: A run at many random points, in one batch.
        """
        found = cls(sites, distributions)
        if any(site.shape or site.batch_shape for site in sites):
            return None
        if any(node["type"] == "param" for node in trace.nodes.values()):
            return None
        for site, own in zip(sites, found.distributions, strict=True):
            node = trace.nodes[site.name]
            if not torch.equal(own.log_prob(node["value"]), node["fn"].log_prob(node["value"])):
                return None
        return found

    @unvalidated()
    def to_parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Maps z, ``(n, d)``, to values of every site, ``(n,)`` each."""
        z = z.double()
        return {
            site.name: to_value(z[:, k]).to(site.dtype)
            for k, (site, to_value) in enumerate(zip(self.sites, self.maps, strict=True))
        }

    @unvalidated()
    def to_reference(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Maps values of every site, ``(n,)`` each, to z, ``(n, d)``."""
        columns = [
            to_value.inverse(parameters[site.name].to(site.dtype)).double()
            for site, to_value in zip(self.sites, self.maps, strict=True)
        ]
        return torch.stack(torch.broadcast_tensors(*columns), dim=-1)

    @unvalidated()
    def on_support(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns which values, ``(n,)`` each, all are on their supports, ``(n,)``."""
        inside = torch.tensor(True)
        for site, distribution in zip(self.sites, self.distributions, strict=True):
            value = parameters[site.name].to(site.dtype)
            inside = inside & distribution.support.check(value) & value.isfinite()
        return inside

    @unvalidated()
    def log_prob_parameters(self, z: Tensor) -> Tensor:
        """Returns the log density over the parameters at z, ``(n,)``."""
        values = self.to_parameters(z)
        total = torch.zeros(len(z), dtype=torch.float64)
        for site, distribution in zip(self.sites, self.distributions, strict=True):
            total = total + distribution.log_prob(values[site.name])
        return total
