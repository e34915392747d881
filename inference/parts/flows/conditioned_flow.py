"""An autoregressive flow at one context, for many points.

A posterior has one context, the features of the observation, perhaps a thousand, and very many
parameter vectors of perhaps ten entries. The context's contribution to a conditioner's first layer
is the same for all of them and computed once. Inverting the flow takes a pass per parameter; each
pass evaluates the outputs of that parameter only.
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import linear
from zuko.flows.autoregressive import MaskedAutoregressiveTransform
from zuko.lazy import LazyComposedTransform
from zuko.nn import MaskedLinear
from zuko.transforms import AutoregressiveTransform, ComposedTransform, DependentTransform
from zuko.utils import unpack

__all__ = ["conditioned"]


def conditioned(flow: LazyComposedTransform, context: Tensor) -> ComposedTransform:
    """Returns a conditional flow's transform at one context, with fixed weights.

    Args:
        flow: The flow.
        context: The context, ``(1, num_features)``.
    """
    return ComposedTransform(
        *(
            _ConditionedTransform(transform, context)
            if isinstance(transform, MaskedAutoregressiveTransform)
            else transform(context)  # with one parameter: the outputs depend on the context only
            for transform in flow.transforms
        )
    )


class _ConditionedTransform(AutoregressiveTransform):
    """One autoregressive transform at a context."""

    def __init__(self, transform: MaskedAutoregressiveTransform, context: Tensor) -> None:
        super().__init__(self._univariates, transform.passes)
        layers: list[Any] = list(transform.hyper)
        masked: list[Any] = [layer for layer in layers if isinstance(layer, MaskedLinear)]
        weights = [(layer.mask * layer.weight).detach() for layer in masked]
        biases = [layer.bias.detach() for layer in masked]
        own = weights[0].shape[1] - context.shape[1]
        biases[0] = biases[0] + weights[0][:, own:] @ context[0].detach()
        weights[0] = weights[0][:, :own].contiguous()
        self._hidden = list(zip(weights[:-1], biases[:-1], strict=True))
        self._last = weights[-1], biases[-1]
        self._activations = [layer for layer in layers if not isinstance(layer, MaskedLinear)]
        self._univariate: Any = transform.univariate
        self._shapes = transform.shapes
        order: Any = transform.order
        self._sequence: list[int] = order.argsort().tolist()

    def _hidden_units(self, x: Tensor) -> Tensor:
        for (weight, bias), activation in zip(self._hidden, self._activations, strict=True):
            x = activation(linear(x, weight, bias))
        return x

    def _univariates(self, x: Tensor) -> Any:
        """Returns the univariate maps of all parameters given x, ``(n, d)``."""
        outputs = linear(self._hidden_units(x), *self._last)
        outputs = outputs.unflatten(-1, (x.shape[-1], -1))
        return DependentTransform(self._univariate(*unpack(outputs, self._shapes)), 1)

    def _inverse(self, y: Tensor) -> Tensor:
        weight, bias = self._last
        size = len(weight) // y.shape[-1]
        x = torch.zeros_like(y)
        for index in self._sequence:
            rows = slice(index * size, (index + 1) * size)
            outputs = linear(self._hidden_units(x), weight[rows], bias[rows])
            univariate = self._univariate(*unpack(outputs, self._shapes))
            x[..., index] = univariate.inv(y[..., index])
        return x
