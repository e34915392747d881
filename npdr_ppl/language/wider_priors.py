"""A handler that widens the priors of some sites, to test whether they were too narrow."""

from collections.abc import Sequence
from typing import Any

import pyro.distributions as dist
import torch
from pyro.distributions.torch_distribution import ExpandedDistribution
from pyro.poutine.messenger import Messenger
from torch import Tensor

from npdr_ppl.language.layers import Layer, layers
from npdr_ppl.language.model import Model

__all__ = [
    "ModelWithWiderPriors",
    "described_prior",
    "wider_sites",
    "widened",
    "with_wider_priors",
]

TIMES = 3.0
"""Factor by which scales of distributions and widths of ranges are multiplied."""

LEAST_SHARE = 0.1
"""A range on one side of zero is widened towards zero only down to this fraction of its end,
because masses and lengths of zero cannot be simulated."""


class WiderPriorsMessenger(Messenger):
    """Replaces the priors of some latent sites by wider ones while a program runs."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = frozenset(names)

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self.names and not msg["is_observed"]:
            wider = widened(msg["fn"])
            if wider is not None:
                msg["fn"] = wider


class ModelWithWiderPriors(Layer):
    """A Pyro model in which the priors of some sites are wider.

    Attributes:
        base: The model.
        names: The sites.
    """

    def __init__(self, base: Model, names: Sequence[str]) -> None:
        self.base = base
        self.names = tuple(names)
        self.__name__ = getattr(base, "__name__", type(base).__name__)
        self.__doc__ = base.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the model with wider priors."""
        return WiderPriorsMessenger(self.names)(self.base)(*args, **kwargs)

    def __repr__(self) -> str:
        return f"{self.__name__} with wider priors of {', '.join(self.names)}"


def with_wider_priors(model: Model, names: Sequence[str]) -> Model:
    """Returns the model with wider priors of some sites.

    A range grows by its own width at both ends but stays on its side of zero. A normal,
    half-normal or log-normal distribution gets three times the scale.

    Args:
        model: A Pyro model.
        names: Latent sites to widen; sites with other kinds of priors keep them.
    """
    return ModelWithWiderPriors(model, names)


def wider_sites(model: Any) -> list[list[str]]:
    """Returns the sites whose priors were widened, one list for each time, the first one first.

    Applied in this order, :func:`with_wider_priors` makes the same priors again.

    Args:
        model: A Pyro model, possibly inside layers of this package.
    """
    return [
        list(layer.names) for layer in layers(model) if isinstance(layer, ModelWithWiderPriors)
    ]


def widened(prior: Any) -> Any | None:
    """Returns a wider prior of the same family, ``None`` for other families.

    Args:
        prior: A Pyro distribution.
    """
    if isinstance(prior, ExpandedDistribution):
        base = widened(prior.base_dist)
        return None if base is None else base.expand(prior.batch_shape)
    if isinstance(prior, dist.Uniform):
        low, high = torch.as_tensor(prior.low), torch.as_tensor(prior.high)
        width = 0.5 * (TIMES - 1.0) * (high - low)
        least, most = low - width, high + width
        least = torch.where(low >= 0.0, torch.maximum(least, LEAST_SHARE * low), least)
        most = torch.where(high <= 0.0, torch.minimum(most, LEAST_SHARE * high), most)
        return dist.Uniform(least, most)
    if isinstance(prior, dist.HalfNormal):
        return dist.HalfNormal(TIMES * prior.scale)
    if isinstance(prior, dist.Normal | dist.LogNormal):
        return type(prior)(prior.loc, TIMES * prior.scale)  # pyright: ignore[reportCallIssue]
    return None


def described_prior(prior: Any) -> str:
    """Returns a prior as readable text, e.g. ``Uniform(0.3, 1.7)``."""
    if isinstance(prior, ExpandedDistribution):
        return described_prior(prior.base_dist)
    name = type(prior).__name__
    if isinstance(prior, dist.Uniform):
        values: list[Any] = [prior.low, prior.high]
    elif isinstance(prior, dist.HalfNormal):
        values = [prior.scale]
    elif isinstance(prior, dist.Normal | dist.LogNormal):
        values = [prior.loc, prior.scale]
    else:
        return name
    shown = [
        f"{float(v):.4g}" if not isinstance(v, Tensor) or v.numel() == 1 else "…" for v in values
    ]
    return f"{name}({', '.join(shown)})"
