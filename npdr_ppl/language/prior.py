"""The prior of a whole program, in reference coordinates.

In the order in which the program samples them, each latent site is written as a function of
standard normal coordinates and of the sites before it (see :mod:`npdr_ppl.language.reference`).
The joint prior of any program, even a dependent or hierarchical one, thereby becomes N(0, I), and
every point maps to a plausible parameter.
"""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import torch
from pyro import poutine
from pyro.distributions.torch_distribution import ExpandedDistribution
from torch import Tensor
from torch.distributions import Independent, Uniform, constraints

from npdr_ppl.errors import ModelError
from npdr_ppl.language.handlers import SkipSimulation
from npdr_ppl.language.independent_sites import IndependentSites
from npdr_ppl.language.latent_sites import (
    Batch,
    CheckSupport,
    LatentSite,
    ReadCoordinates,
    WriteCoordinates,
    per_point,
)
from npdr_ppl.language.model import Model
from npdr_ppl.language.program_runs import (
    ALL_POINTS,
    BATCH_PLATE,
    alone,
    sample_sites,
    traced,
)
from npdr_ppl.language.reference import reference_map
from npdr_ppl.language.sites import BlackBox

__all__ = ["LatentSite", "Prior"]

_CHECKED_SCALES = 1.0, 2.0, 4.0, 8.0
"""Standard deviations of the points at which sites are checked for their dependence on each other:
a distribution may change only far from the middle of another one."""

_NUM_CHECKED = 64
"""Number of such points of each standard deviation."""


class Prior:
    """The joint prior of a program's latent sites.

    Args:
        model: A Pyro model.
        args: Its positional arguments.

    Attributes:
        sites: The latent sites, in the order of sampling.
        black_boxes: The black-box sites by name, from one run of the program.
        distributions: The latent sites' distributions by name, from one run of the program.
        num_parameters: Dimension d of the reference coordinates.
        is_standard_normal: Whether the prior over z is exactly N(0, I).
        max_plate_nesting: Depth of the model's plates.

    Raises:
        ModelError: There is no latent site, one is discrete, a site does not fit its plates, or
            the density of an observed ordinary site depends on latent sites.
    """

    def __init__(self, model: Model, args: tuple[Any, ...] = ()) -> None:
        self.model = model
        self.args = args
        with alone(), torch.random.fork_rng(devices=[]), SkipSimulation():
            torch.manual_seed(0)
            prototype = traced(model, args)
        self.black_boxes: dict[str, BlackBox] = {
            name: site["fn"]
            for name, site in sample_sites(prototype)
            if isinstance(site["fn"], BlackBox)
        }
        self.sites: tuple[LatentSite, ...] = self._latent_sites(prototype)
        if not self.sites:
            raise ModelError("The model has no latent sample sites, so there is nothing to infer.")
        self._check_plates(prototype)
        self.num_parameters = self.sites[-1].coordinates.stop
        self._check_observed_sites(prototype)

    def _latent_sites(self, prototype: Any) -> tuple[LatentSite, ...]:
        depths = [0]
        sites = []
        self.distributions: dict[str, Any] = {}
        stop = 0
        self.is_standard_normal = True
        for name, site in sample_sites(prototype):
            depths += [-frame.dim for frame in site["cond_indep_stack"] if frame.dim is not None]
            if site["is_observed"] or name in self.black_boxes:
                continue
            fn = site["fn"]
            if fn.support.is_discrete:
                raise ModelError(
                    f"Site {name!r} is discrete ({type(fn).__name__}); latent sites must be "
                    "continuous: marginalise it inside the simulator, or relax it."
                )
            _check_parameters(name, fn)
            self.distributions[name] = fn
            to_value = reference_map(fn)
            self.is_standard_normal &= to_value.is_standard_normal
            coordinate_shape = torch.Size(fn.batch_shape + to_value.event_shape)
            start, stop = stop, stop + coordinate_shape.numel()
            sites.append(
                LatentSite(
                    name,
                    torch.Size(fn.batch_shape),
                    site["value"].shape,
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

    def _check_plates(self, prototype: Any) -> None:
        """Rejects sites with more dimensions than the plates around them."""
        for site in self.sites:
            loose = len(site.batch_shape) - self.max_plate_nesting
            if loose > 0:
                raise ModelError(
                    f"Site {site.name!r} has the batch shape {tuple(site.batch_shape)} and no "
                    f"plate around it; put it into a pyro.plate, or make it one vector with "
                    f".to_event({loose})."
                )
        for name, box in self.black_boxes.items():
            shape = tuple(box.batch_shape)
            if any(size != 1 for size in shape[: max(0, len(shape) - _depth(prototype, name))]):
                raise ModelError(
                    f"Site {name!r} takes parameters of shape {shape} outside of the plate that "
                    "they belong to; move it into the plate."
                )

    def _check_observed_sites(self, prototype: Any) -> None:
        """Rejects ordinary likelihoods, which likelihood-free backends would ignore."""
        ordinary = [
            name
            for name, site in sample_sites(prototype)
            if site["is_observed"] and name not in self.black_boxes
        ]
        if not ordinary:
            return
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            trace = self._run(WriteCoordinates(self.sites, torch.randn(8, self.num_parameters)))
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

    @cached_property
    def _independent(self) -> IndependentSites | None:
        """The sites if :class:`IndependentSites` can stand for their program, else ``None``."""
        if not self.is_standard_normal:
            return None
        generator = torch.Generator().manual_seed(0)
        z = torch.randn(_NUM_CHECKED, self.num_parameters, generator=generator).double()
        z = torch.cat([scale * z for scale in _CHECKED_SCALES])
        return IndependentSites.of(
            self.sites, self.distributions, self._run(WriteCoordinates(self.sites, z))
        )

    def sample(self, num_samples: int) -> Tensor:
        """Draws z from the prior, ``(num_samples, d)`` float64, from torch's global stream."""
        if self.is_standard_normal:
            return torch.randn(num_samples, self.num_parameters, dtype=torch.float64)
        with alone(), SkipSimulation(), Batch(self.max_plate_nesting, num_samples):
            trace = traced(self.model, self.args)
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
        writer = WriteCoordinates(self.sites, z)
        self._run(writer)
        return writer.log_prob

    @cached_property
    def uniform_coordinates(self) -> Tensor:
        """Mask ``(d,)`` of the coordinates of sites with uniform distributions."""
        mask = torch.zeros(self.num_parameters, dtype=torch.bool)
        for site in self.sites:
            fn = self.distributions[site.name]
            while isinstance(fn, ExpandedDistribution | Independent):
                fn = fn.base_dist
            mask[site.coordinates] = isinstance(fn, Uniform)
        return mask

    def to_parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Maps z, ``(n, d)``, to values of every latent site, ``(n,) + site.shape``."""
        if self._independent is not None:
            return self._independent.to_parameters(z)
        trace = self._run(WriteCoordinates(self.sites, z))
        return {
            site.name: self._without_padding(site, trace.nodes[site.name]["value"])
            for site in self.sites
        }

    def to_reference(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Maps values of every latent site, ``(n,) + site.shape``, to z; differentiable."""
        if self._independent is not None:
            return self._independent.to_reference(parameters)
        num = next(iter(parameters.values())).shape[0]
        data = self._padded(parameters)
        messenger = ReadCoordinates(self.sites)
        with alone(), SkipSimulation(), Batch(self.max_plate_nesting, num):
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
        if self._independent is not None:
            return self._independent.on_support(parameters)
        num = next(iter(parameters.values())).shape[0]
        checker = CheckSupport(self._padded(parameters), num)
        with alone(), SkipSimulation(), checker, Batch(self.max_plate_nesting, num):
            self.model(*self.args)
        return checker.mask

    def log_prob_parameters(self, z: Tensor) -> Tensor:
        """Returns the prior's log density over the parameters at z, ``(n,)``."""
        if self._independent is not None:
            return self._independent.log_prob_parameters(z)
        trace = self._run(WriteCoordinates(self.sites, z))
        total = torch.zeros(z.shape[0], dtype=torch.float64)
        for site in self.sites:
            node = trace.nodes[site.name]
            total = total + per_point(node["fn"].log_prob(node["value"]), z.shape[0])
        return total

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Returns log |∂ξ/∂z|, ``(n,)``, so that log q(ξ) = log q(z) − log |∂ξ/∂z|."""
        return self.log_prob(z) - self.log_prob_parameters(z)

    def execute(self, z: Tensor) -> dict[str, Tensor]:
        """Simulates the program at n points, ``(n, d)``, at once.

        Returns:
            The output of each black-box site, ``(n,) + plates + event``.
        """
        with alone(), WriteCoordinates(self.sites, z), Batch(self.max_plate_nesting, z.shape[0]):
            return self._outputs(traced(self.model, self.args))

    def black_boxes_at(self, z: Tensor) -> dict[str, BlackBox]:
        """Returns the black-box sites as the program makes them at n points, ``(n, d)``.

        Their parameters have the shape ``(n,) + plates``, or fewer dimensions if the program
        uses one value for all points. Nothing is simulated.
        """
        trace = self._run(WriteCoordinates(self.sites, z))
        return {name: trace.nodes[name]["fn"] for name in self.black_boxes}

    def execute_at(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Simulates the program at n given values of its latent sites.

        Args:
            parameters: Values ``(n,) + site.shape`` by site name, on the support or not.

        Returns:
            The output of each black-box site, ``(n,) + plates + event``.
        """
        num = next(iter(parameters.values())).shape[0]
        data = self._padded(parameters)
        with alone(), Batch(self.max_plate_nesting, num), poutine.condition(data=data):
            return self._outputs(traced(self.model, self.args))

    def _outputs(self, trace: Any) -> dict[str, Tensor]:
        result = {}
        for name in self.black_boxes:
            value = trace.nodes[name]["value"]
            # Plates that do not enclose this site have their dimensions after the batch.
            skipped = self.max_plate_nesting - _depth(trace, name)
            if any(size != 1 for size in value.shape[1 : 1 + skipped]):
                size = max(value.shape[1 : 1 + skipped])
                raise ModelError(
                    f"Site {name!r} has {size} values in a dimension that no plate around it has. "
                    f"{ALL_POINTS}"
                )
            result[name] = value.reshape((value.shape[0], *value.shape[1 + skipped :]))
        return result

    def _padded(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            site.name: self._with_padding(site, parameters[site.name].to(site.dtype))
            for site in self.sites
        }

    def pointwise_log_prob(self, name: str, value: Tensor, z: Tensor) -> Tensor:
        """Returns the density of every measurement at a black-box site, ``(n,) + value.shape``.

        It is differentiable in z if the simulator is differentiable.

        Args:
            name: The site.
            value: Observation at the site.
            z: Points, ``(n, d)``.

        Raises:
            IntractableError: The site has no density.
        """
        trace = self._run(WriteCoordinates(self.sites, z))
        log_prob, _ = trace.nodes[name]["fn"].pointwise_log_prob(value)
        return log_prob.reshape((len(z), *value.shape))

    def _run(self, writer: WriteCoordinates) -> Any:
        """Runs the program at all points of a writer at once, without simulating."""
        with alone(), SkipSimulation(), writer, Batch(self.max_plate_nesting, writer.num_points):
            return traced(self.model, self.args)

    def _with_padding(self, site: LatentSite, value: Tensor) -> Tensor:
        padding = (1,) * (self.max_plate_nesting - len(site.batch_shape))
        return value.reshape((value.shape[0], *padding, *site.shape))

    def _without_padding(self, site: LatentSite, value: Tensor) -> Tensor:
        return value.reshape((value.shape[0], *site.shape))


def _check_parameters(name: str, fn: Any) -> None:
    """Checks what a site's distribution was made from; a program runs without validation."""
    while hasattr(fn, "base_dist"):
        fn = fn.base_dist
    low, high = (getattr(fn.support, f"{end}_bound", None) for end in ("lower", "upper"))
    is_valid = low is None or high is None or bool((torch.as_tensor(low) < high).all())
    for word, constraint in fn.arg_constraints.items():
        value = getattr(fn, word, None)
        if isinstance(value, Tensor) and not constraints.is_dependent(constraint):
            is_valid &= bool(constraint.check(value).all())
    if not is_valid:
        raise ModelError(
            f"Site {name!r} has no valid {type(fn).__name__}: check its bounds and scales, which "
            "must be finite, positive where they are scales, and in order."
        )


def _depth(trace: Any, name: str) -> int:
    """Returns the number of dimensions of the program's own plates around a site."""
    frames = trace.nodes[name]["cond_indep_stack"]
    return max((-frame.dim for frame in frames if frame.name != BATCH_PLATE), default=0)
