"""Conditional normalising flows from zuko, and the posterior density that they define.

A member of an ensemble is a :class:`FlowNetwork`. Several of them are stored and trained as one
stack of weights; each gives a :class:`FlowDensity`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Transform
from zuko.flows.autoregressive import MaskedAutoregressiveTransform
from zuko.lazy import LazyComposedTransform
from zuko.nn import Linear
from zuko.transforms import MonotonicAffineTransform, MonotonicRQSTransform

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.flows.conditioned_flow import conditioned
from npdr_ppl.inference.parts.flows.flow_base import CHUNK, FlowBase, finite_samples
from npdr_ppl.inference.parts.training.embedding_network import build_embedding
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = [
    "FLOWS",
    "Flow",
    "FlowDensity",
    "FlowNetwork",
    "build_networks",
]

Flow = Literal["nsf", "maf", "affine-nsf"]
FLOWS = ("nsf", "maf", "affine-nsf")
"""Kinds of flows, see :class:`FlowNetwork`."""

INITIAL_SCALE = 0.01
"""Factor on the last layer's initial weights. A flow therefore starts near the identity, that is,
at the preconditioner's linear-Gaussian posterior, and training never ends at a worse one."""

STANDARD_NORMAL = FlowBase()


class Spline(MonotonicRQSTransform):
    """zuko's monotonic rational-quadratic spline on [-5, 5], with faster computation of knots.

    The knots are those of the parent class. It normalises bin widths and heights by a softmax over
    a last dimension of a few bins. On a CPU that takes longer than all the rest of the spline. The
    parameters are bounded before, so that plain exponentials cannot overflow.

    Args:
        bins: Unconstrained bin widths and heights, ``(*, 2, K)``.
        derivatives: Unconstrained derivatives at the inner knots, ``(*, K - 1)``.
        bound: Edge of the interval; beyond it the map is the identity.
        slope: Smallest slope of the spline.
    """

    def __init__(
        self, bins: Tensor, derivatives: Tensor, bound: float = 5.0, slope: float = 1e-3
    ) -> None:
        Transform.__init__(self)
        limit = -math.log(slope)
        sizes = (bins / (1 + (2 / limit) * bins.abs())).exp()
        ends = sizes.cumsum(-1)
        knots = nn.functional.pad(
            ends * (2 * bound / ends[..., -1:]) - bound, (1, 0), value=-bound
        )
        self.horizontal, self.vertical = knots.unbind(-2)
        inner = derivatives / (1 + derivatives.abs() / limit)
        self.derivatives = nn.functional.pad(inner, (1, 1)).exp()


class FlowNetwork(nn.Module):
    """A conditional flow T with an optional embedding network h.

    Its density of whitened parameters u given standardised features f is

        log q(u | f) = log N(T(u; h(f)); 0, I) + log |det dT/du|.

    Every transform is fully autoregressive, u_i given u_<i, so that a single transform can
    represent any density. The order alternates between transforms and between members.

    Args:
        num_parameters: Dimension d of u.
        num_features: Length of h(f).
        embedding: Network h, or ``None`` for the identity.
        flow: ``"nsf"``, monotonic rational-quadratic splines (Durkan et al. 2019); ``"maf"``,
            affine maps (Papamakarios et al. 2017); or ``"affine-nsf"``, splines after one affine
            map, which represents conditional scales that vary by orders of magnitude.
        transforms: Number of autoregressive transforms.
        hidden: Widths of the conditioners' hidden layers.
        bins: Number of bins of a spline.
        is_reversed: Whether the first transform has the parameters in reverse order.
    """

    def __init__(
        self,
        num_parameters: int,
        num_features: int,
        embedding: nn.Module | None,
        flow: Flow,
        transforms: int,
        hidden: tuple[int, ...],
        bins: int,
        is_reversed: bool,
    ) -> None:
        super().__init__()
        self.embedding = embedding
        forwards: Any = torch.arange(num_parameters)
        self.transform = LazyComposedTransform(
            *(
                MaskedAutoregressiveTransform(
                    num_parameters,
                    num_features,
                    order=forwards.flip(0) if (k + is_reversed) % 2 else forwards,
                    univariate=univariate,
                    shapes=[torch.Size(size) for size in sizes],
                    hidden_features=hidden,
                )
                for k, (univariate, sizes) in enumerate(_univariate(flow, transforms, bins))
            )
        )
        linear = (nn.Linear, Linear)  # with a single parameter zuko's own
        for transform in self.transform.transforms:
            last = [layer for layer in transform.modules() if isinstance(layer, linear)][-1]
            with torch.no_grad():
                last.weight.mul_(INITIAL_SCALE)
                if last.bias is not None:
                    last.bias.zero_()

    def context(self, f: Tensor) -> Tensor:
        """Returns h(f), ``(n, num_features)``, at standardised features ``(n, ...)``."""
        return f if self.embedding is None else self.embedding(f)

    def forward(self, u: Tensor, f: Tensor) -> Tensor:
        """Returns log q(u | f) in u's leading shape.

        Args:
            u: Whitened parameters, ``(n, d)``, or several for each context, ``(n, atoms, d)``.
            f: Standardised features, ``(n, ...)``.
        """
        context = self.context(f)
        if u.ndim == 3:
            context = context[:, None].expand(-1, u.shape[1], -1)
        return self.log_prob(u, context)

    def log_prob(self, u: Tensor, context: Tensor) -> Tensor:
        """Returns log q(u | f), ``(n,)``, given h(f), ``(n, num_features)``."""
        base, log_det = self.transform(context).call_and_ladj(u)
        return log_det - 0.5 * (base**2 + math.log(2 * math.pi)).sum(-1)


def _univariate(flow: str, transforms: int, bins: int) -> Sequence[Any]:
    """Returns the univariate map of each transform and the shapes of its parameters."""
    spline = Spline, [(2, bins), (bins - 1,)]
    affine = MonotonicAffineTransform, [(), ()]
    if flow == "affine-nsf":
        return [affine] + (transforms - 1) * [spline]
    return transforms * [spline if flow == "nsf" else affine]


def build_networks(
    members: int,
    num_parameters: int,
    observation: Tensor,
    build: Callable[[], nn.Module] | None,
    flow: Flow,
    transforms: int,
    hidden: tuple[int, ...],
    bins: int,
) -> list[FlowNetwork]:
    """Builds an ensemble's untrained networks.

    Args:
        members: Number of networks.
        num_parameters: Dimension d.
        observation: An observation, ``(F,)`` or of the shape the embedding network takes.
        build: Function that makes an untrained embedding network, or ``None``.
        flow: See :class:`FlowNetwork`, as for the rest.
        transforms: Number of transforms.
        hidden: Widths of hidden layers.
        bins: Number of bins of a spline.

    Raises:
        BackendError: The embedding network does not map a batch to ``(n, features)``.
    """
    networks = []
    for member in range(members):
        embedding, num_features = build_embedding(build, observation)
        networks.append(
            FlowNetwork(
                num_parameters,
                num_features,
                embedding,
                flow,
                transforms,
                hidden,
                bins,
                is_reversed=bool(member % 2),
            )
        )
    return networks


class FlowDensity(Density):
    """The posterior of one ensemble member given the observation.

    Samples are returned on the CPU, log densities on their argument's device, for any device of
    the network.

    Args:
        network: A trained network, on the CPU or a GPU.
        preconditioner: The preconditioner fitted before training, on the same device.
        observation: Observation x_o, ``(F,)`` or a raw array, on the same device.
        base: The flow's base density.
    """

    def __init__(
        self,
        network: FlowNetwork,
        preconditioner: Preconditioner,
        observation: Tensor,
        base: FlowBase = STANDARD_NORMAL,
    ) -> None:
        self._base = base
        self._preconditioner = preconditioner
        self._features = preconditioner.features(observation[None])
        with torch.no_grad():
            self._transform: Any = conditioned(network.transform, network.context(self._features))

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream."""
        d = len(self._preconditioner.offset)

        def draw(n: int) -> Tensor:
            # Rounding can make the quadratic that inverts a spline unsolvable at a knot.
            u = self._transform.inv(self._base.sample(n, d).to(self._features.device))
            return self._preconditioner.unwhiten(u, self._features)

        return finite_samples(draw, num_samples, d)

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``; differentiable in z."""
        return torch.cat([self._log_prob(part) for part in z.split(CHUNK)])

    def _log_prob(self, z: Tensor) -> Tensor:
        u = self._preconditioner.whiten(z.to(self._features.device), self._features)
        base, log_det = self._transform.call_and_ladj(u)
        log_q = log_det + self._base.log_prob((base**2).sum(-1), u.shape[-1])
        return (log_q + self._preconditioner.log_det).to(z.device)
