"""Latent sites of a program, and the handlers that write and read their reference coordinates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from pyro.poutine.broadcast_messenger import BroadcastMessenger
from pyro.poutine.indep_messenger import CondIndepStackFrame
from pyro.poutine.messenger import Messenger
from torch import Tensor

from npdr_ppl.language.program_runs import BATCH_PLATE
from npdr_ppl.language.reference import reference_map

__all__ = [
    "Batch",
    "CheckSupport",
    "LatentSite",
    "ReadCoordinates",
    "WriteCoordinates",
    "per_point",
]


@dataclass(frozen=True)
class LatentSite:
    """A latent sample site of a program.

    Attributes:
        name: Name of the site.
        batch_shape: Shape of its plates.
        shape: Shape of one value, plates included.
        coordinates: Its slice of the vector z.
        dtype: Floating-point type in which the program samples it.
        plates: Its plates as (name, size, dimension), outermost first.
    """

    name: str
    batch_shape: torch.Size
    shape: torch.Size
    coordinates: slice
    dtype: torch.dtype
    plates: tuple[tuple[str, int, int], ...] = ()


class Batch(Messenger):
    """A plate to the left of the model's plates, which evaluates all points in one run.

    ``pyro.plate`` itself would use the same dimension as plates of a caller's program, such as
    Predictive's.
    """

    def __init__(self, max_plate_nesting: int, size: int) -> None:
        super().__init__()
        self._frame = CondIndepStackFrame(BATCH_PLATE, -1 - max_plate_nesting, size, 0)

    def _process_message(self, msg: Any) -> None:
        msg["cond_indep_stack"] = (self._frame, *msg["cond_indep_stack"])
        if msg["type"] == "sample":
            BroadcastMessenger._pyro_sample(msg)


class WriteCoordinates(Messenger):
    """Sets each latent site to the value for its coordinates."""

    def __init__(self, sites: Sequence[LatentSite], z: Tensor) -> None:
        super().__init__()
        self._sites = {site.name: site for site in sites}
        self._z = z.double()
        self.num_points = z.shape[0]
        self.log_prob = torch.zeros(self.num_points, dtype=torch.float64)

    def _pyro_sample(self, msg: Any) -> None:
        site = self._sites.get(msg["name"])
        if site is None:
            return
        fn = msg["fn"]
        to_value = reference_map(fn)
        z = self._z[:, site.coordinates].reshape(tuple(fn.batch_shape) + to_value.event_shape)
        msg["value"] = to_value(z).to(site.dtype)
        self.log_prob = self.log_prob + per_point(to_value.log_prob(z), self.num_points)


class ReadCoordinates(Messenger):
    """Computes the coordinates of each latent site from its value."""

    def __init__(self, sites: Sequence[LatentSite]) -> None:
        super().__init__()
        self._sites = {site.name: site for site in sites}
        self.z: dict[str, Tensor] = {}

    def _pyro_post_sample(self, msg: Any) -> None:
        if msg["name"] in self._sites:
            z = reference_map(msg["fn"]).inverse(msg["value"])
            self.z[msg["name"]] = z.double().reshape(z.shape[0], -1)


class CheckSupport(Messenger):
    """Sets each latent site to its value if that is on its support, else to its median.

    Without the median, an impossible value would give later sites an invalid distribution.
    """

    def __init__(self, values: Mapping[str, Tensor], num_points: int) -> None:
        super().__init__()
        self._values = values
        self.mask = torch.ones(num_points, dtype=torch.bool)

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] not in self._values:
            return
        fn, value = msg["fn"], self._values[msg["name"]]
        finite = value.isfinite()
        finite = finite.flatten(-len(fn.event_shape)).all(-1) if fn.event_shape else finite
        inside = fn.support.check(value) & finite
        self.mask = self.mask & inside.reshape(len(self.mask), -1).all(-1)
        to_value = reference_map(fn)
        median = to_value(value.new_zeros(tuple(fn.batch_shape) + to_value.event_shape))
        inside = inside.reshape(inside.shape + (1,) * len(fn.event_shape))
        msg["value"] = torch.where(inside, value, median.to(value.dtype))


def per_point(log_prob: Tensor, num_points: int) -> Tensor:
    """Sums a log density over all dimensions except the batch dimension."""
    if log_prob.dim() == 0:
        return log_prob.expand(num_points)
    return log_prob.flatten(1).sum(-1) if log_prob.dim() > 1 else log_prob
