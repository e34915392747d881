"""The prior of a whole program, in reference coordinates.

Site by site, in the order in which the program samples them, each latent site is written as a
function of standard normal coordinates and of the sites before it (see
:mod:`npdr_ppl.language.reference`). The joint prior of any program, dependent and hierarchical
ones included, thereby becomes N(0, I), and every point maps to a plausible parameter.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from pyro import poutine
from pyro.poutine.broadcast_messenger import BroadcastMessenger
from pyro.poutine.indep_messenger import CondIndepStackFrame
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.errors import ModelError, NpdrError
from npdr_ppl.language.handlers import SkipSimulation
from npdr_ppl.language.reference import reference_map
from npdr_ppl.language.sites import BlackBox

__all__ = ["LatentSite", "Prior"]

BATCH_PLATE = "_npdr_batch"


@dataclass(frozen=True)
class LatentSite:
    """A latent sample site of a program.

    Attributes:
        name: Name of the site.
        batch_shape: Shape of its plates.
        shape: Shape of one value, plates included.
        coordinate_shape: Shape of its reference coordinates, plates included.
        coordinates: Its place in the vector z.
        dtype: Precision in which the program samples it.
        plates: Its plates as (name, size, dimension), outermost first.
    """

    name: str
    batch_shape: torch.Size
    shape: torch.Size
    coordinate_shape: torch.Size
    coordinates: slice
    dtype: torch.dtype
    plates: tuple[tuple[str, int, int], ...] = ()


class Prior:
    """The joint prior of a program's latent sites.

    Args:
        model: A Pyro model.
        args: Its positional arguments.

    Attributes:
        sites: The latent sites, in the order of sampling.
        black_boxes: The black-box sites by name, as one run of the program made them.
        num_parameters: Dimension d of the reference coordinates.
        is_standard_normal: Whether the prior over z is exactly N(0, I).
        max_plate_nesting: Depth of the model's plates.

    Raises:
        ModelError: A latent site is discrete, there is none, or an ordinary site is observed
            whose density depends on latent sites.
    """

    def __init__(self, model: Callable[..., Any], args: tuple[Any, ...] = ()) -> None:
        self.model = model
        self.args = args
        with _alone(), torch.random.fork_rng(devices=[]), SkipSimulation():
            torch.manual_seed(0)
            prototype = _trace(model, args)
        self.black_boxes: dict[str, BlackBox] = {
            name: site["fn"]
            for name, site in _samples(prototype)
            if isinstance(site["fn"], BlackBox)
        }
        self.sites: tuple[LatentSite, ...] = self._latent_sites(prototype)
        if not self.sites:
            raise ModelError("The model has no latent sample sites, so there is nothing to infer.")
        self.num_parameters = self.sites[-1].coordinates.stop
        self._check_observed_sites(prototype)

    def _latent_sites(self, prototype: Any) -> tuple[LatentSite, ...]:
        depths = [0]
        sites = []
        stop = 0
        self.is_standard_normal = True
        for name, site in _samples(prototype):
            depths += [-frame.dim for frame in site["cond_indep_stack"] if frame.dim is not None]
            if site["is_observed"] or name in self.black_boxes:
                continue
            fn = site["fn"]
            if fn.support.is_discrete:
                raise ModelError(
                    f"Site {name!r} is discrete ({type(fn).__name__}); latent sites must be "
                    "continuous: marginalise it inside the simulator, or relax it."
                )
            to_value = reference_map(fn)
            self.is_standard_normal &= to_value.is_standard_normal
            coordinate_shape = torch.Size(fn.batch_shape + to_value.event_shape)
            start, stop = stop, stop + coordinate_shape.numel()
            sites.append(
                LatentSite(
                    name,
                    torch.Size(fn.batch_shape),
                    site["value"].shape,
                    coordinate_shape,
                    slice(start, stop),
                    site["value"].dtype,
                    tuple(
                        (frame.name, frame.size, frame.dim)
                        for frame in sorted(site["cond_indep_stack"], key=lambda f: f.dim)
                    ),
                )
            )
        self.max_plate_nesting = max(depths)
        return tuple(sites)

    def _check_observed_sites(self, prototype: Any) -> None:
        """Refuses ordinary likelihoods, which no likelihood-free backend would see."""
        ordinary = [
            name
            for name, site in _samples(prototype)
            if site["is_observed"] and name not in self.black_boxes
        ]
        if not ordinary:
            return
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            trace = self._run(_WriteCoordinates(self, torch.randn(8, self.num_parameters)))
        for name in ordinary:
            site = trace.nodes[name]
            log_prob = site["fn"].log_prob(site["value"])
            if log_prob.numel() > 1 and not torch.allclose(
                log_prob, log_prob.flatten()[0].expand_as(log_prob)
            ):
                raise ModelError(
                    f"Site {name!r} is observed and depends on latent sites, but is not a "
                    "black-box site; declare it with npdr.simulate, or use NUTS."
                )

    def sample(self, num_samples: int) -> Tensor:
        """Draws z from the prior, ``(num_samples, d)`` float64, from torch's global stream."""
        if self.is_standard_normal:
            return torch.randn(num_samples, self.num_parameters, dtype=torch.float64)
        with _alone(), SkipSimulation(), _Batch(self, num_samples):
            trace = _trace(self.model, self.args)
        return self.to_reference(
            {
                site.name: self._without_padding(site, trace.nodes[site.name]["value"])
                for site in self.sites
            }
        )

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density of the prior over z, ``(n,)``, at ``(n, d)``; differentiable."""
        z = z.double()
        if self.is_standard_normal:
            return -0.5 * (z.square() + math.log(2 * math.pi)).sum(-1)
        writer = _WriteCoordinates(self, z)
        self._run(writer)
        return writer.log_prob

    def to_parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Maps z, ``(n, d)``, to values of every latent site, ``(n,) + site.shape``."""
        trace = self._run(_WriteCoordinates(self, z))
        return {
            site.name: self._without_padding(site, trace.nodes[site.name]["value"])
            for site in self.sites
        }

    def to_reference(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Maps values of every latent site, ``(n,) + site.shape``, to z; differentiable."""
        num = next(iter(parameters.values())).shape[0]
        data = self._padded(parameters)
        messenger = _ReadCoordinates(self)
        with _alone(), SkipSimulation(), _Batch(self, num):
            with poutine.condition(data=data), messenger:
                self.model(*self.args)
        return torch.cat([messenger.z[site.name].expand(num, -1) for site in self.sites], dim=-1)

    def on_support(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns which values of the latent sites lie on their supports.

        Args:
            parameters: Values ``(n,) + site.shape`` by site name.

        Returns:
            Mask ``(n,)``; NaN and infinity are off every support.
        """
        num = next(iter(parameters.values())).shape[0]
        checker = _CheckSupport(self._padded(parameters), num)
        with _alone(), SkipSimulation(), checker, _Batch(self, num):
            self.model(*self.args)
        return checker.mask

    def log_prob_parameters(self, z: Tensor) -> Tensor:
        """Returns the prior's log density over the parameters at z, ``(n,)``."""
        trace = self._run(_WriteCoordinates(self, z))
        total = torch.zeros(z.shape[0], dtype=torch.float64)
        for site in self.sites:
            node = trace.nodes[site.name]
            total = total + _per_point(node["fn"].log_prob(node["value"]), z.shape[0])
        return total

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Returns log |∂ξ/∂z|, ``(n,)``, so that log q(ξ) = log q(z) − log |∂ξ/∂z|."""
        return self.log_prob(z) - self.log_prob_parameters(z)

    def execute(self, z: Tensor) -> dict[str, Tensor]:
        """Simulates the program at n points, ``(n, d)``, at once.

        Returns:
            The output of each black-box site, ``(n,) + plates + event``.
        """
        with _alone(), _WriteCoordinates(self, z), _Batch(self, z.shape[0]):
            return self._outputs(_trace(self.model, self.args))

    def execute_at(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Simulates the program at n given values of its latent sites.

        Args:
            parameters: Values ``(n,) + site.shape`` by site name, on the support or not.

        Returns:
            The output of each black-box site, ``(n,) + plates + event``.
        """
        num = next(iter(parameters.values())).shape[0]
        data = self._padded(parameters)
        with _alone(), _Batch(self, num), poutine.condition(data=data):
            return self._outputs(_trace(self.model, self.args))

    def _outputs(self, trace: Any) -> dict[str, Tensor]:
        result = {}
        for name in self.black_boxes:
            node = trace.nodes[name]
            depths = [
                -frame.dim for frame in node["cond_indep_stack"] if frame.name != BATCH_PLATE
            ]
            # Dimensions of plates that do not enclose this site stand behind the batch.
            skipped = self.max_plate_nesting - max(depths, default=0)
            value = node["value"]
            result[name] = value.reshape((value.shape[0], *value.shape[1 + skipped :]))
        return result

    def _padded(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            site.name: self._with_padding(site, parameters[site.name].to(site.dtype))
            for site in self.sites
        }

    def pointwise_log_prob(self, name: str, value: Tensor, z: Tensor) -> Tensor:
        """Returns the density of every reading at a black-box site, ``(n,) + value.shape``.

        It is differentiable in z where the simulator is.

        Args:
            name: The site.
            value: What was observed there.
            z: Points, ``(n, d)``.

        Raises:
            IntractableError: The site has no density.
        """
        trace = self._run(_WriteCoordinates(self, z))
        log_prob, _ = trace.nodes[name]["fn"].pointwise_log_prob(value)
        return log_prob.reshape((len(z), *value.shape))

    def _run(self, writer: "_WriteCoordinates") -> Any:
        """Runs the program at all of a writer's points at once, without simulating."""
        with _alone(), SkipSimulation(), writer, _Batch(self, writer.num_points):
            return _trace(self.model, self.args)

    def _with_padding(self, site: LatentSite, value: Tensor) -> Tensor:
        padding = (1,) * (self.max_plate_nesting - len(site.batch_shape))
        return value.reshape((value.shape[0], *padding, *site.shape))

    def _without_padding(self, site: LatentSite, value: Tensor) -> Tensor:
        return value.reshape((value.shape[0], *site.shape))


class _Batch(Messenger):
    """A plate left of the model's own: all points in one run.

    ``pyro.plate`` itself would compete with plates of a caller's program, such as Predictive's,
    for the same dimension.
    """

    def __init__(self, prior: Prior, size: int) -> None:
        super().__init__()
        self._frame = CondIndepStackFrame(BATCH_PLATE, -1 - prior.max_plate_nesting, size, 0)

    def _process_message(self, msg: Any) -> None:
        msg["cond_indep_stack"] = (self._frame, *msg["cond_indep_stack"])
        if msg["type"] == "sample":
            BroadcastMessenger._pyro_sample(msg)


class _WriteCoordinates(Messenger):
    """Gives each latent site the value that its coordinates stand for."""

    def __init__(self, prior: Prior, z: Tensor) -> None:
        super().__init__()
        self._sites = {site.name: site for site in prior.sites}
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
        self.log_prob = self.log_prob + _per_point(to_value.log_prob(z), self.num_points)


class _ReadCoordinates(Messenger):
    """Reads the coordinates of each latent site off its value."""

    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self._sites = {site.name: site for site in prior.sites}
        self.z: dict[str, Tensor] = {}

    def _pyro_post_sample(self, msg: Any) -> None:
        if msg["name"] in self._sites:
            z = reference_map(msg["fn"]).inverse(msg["value"])
            self.z[msg["name"]] = z.double().reshape(z.shape[0], -1)


class _CheckSupport(Messenger):
    """Gives each latent site a value if that lies on its support, and its median elsewhere.

    Without the median, a site whose distribution depends on an impossible value could not be.
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


@contextmanager
def _alone() -> Iterator[None]:
    """Keeps a run of the program to itself: outside handlers do not see it.

    Values are not validated: those off a support are asked about on purpose, and a simulation that
    gave NaN costs only itself. Pyro's own switch would not do, because other libraries change
    torch's default behind its back.
    """
    is_validating = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        with poutine.block():
            yield
    finally:
        Distribution.set_default_validate_args(is_validating)


def _trace(model: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Traces a run of the program; our own errors come out without Pyro's table of shapes."""
    try:
        return poutine.trace(model).get_trace(*args)
    except NpdrError as error:
        while isinstance(error.__cause__, NpdrError):
            error = error.__cause__
        raise error from None


def _samples(trace: Any) -> list[tuple[str, Any]]:
    return [
        (name, site)
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site_is_subsample(site)
    ]


def _per_point(log_prob: Tensor, num_points: int) -> Tensor:
    """Sums a log density over all dimensions but the batch's."""
    if log_prob.dim() == 0:
        return log_prob.expand(num_points)
    return log_prob.flatten(1).sum(-1) if log_prob.dim() > 1 else log_prob
