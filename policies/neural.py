"""A small neural network whose weights are the policy's parameters."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.errors import ShapeError
from npdr_ppl.policies.base import Policy, PolicyParameter
from npdr_ppl.policies.linear import Features, Units, affine, feature_names, units

__all__ = ["Neural"]


class Neural(Policy):
    """A multilayer perceptron: h₀ = φ(o)/s, h_l = tanh(W_l h_{l−1} + b_l), u = m + r tanh(…).

    The last tanh keeps the commands within the actions' limits of centre m and half-width r.

    Every weight is a separate tensor in the loop (see :data:`~npdr_ppl.policies.linear.Units`), so
    that each policy of a batch has its own network. A step takes one operation per weight. The
    network is therefore meant for tens to a few hundred weights, as evolutionary policy search is.

    Args:
        observations: Names of the sensor channels o.
        actions: Names of the A action channels.
        limits: Least and greatest command of each action.
        hidden: Number of units of each hidden layer; without any it is a linear policy behind a
            tanh.
        features: φ; ``None`` for the observations themselves.
        scales: Typical magnitude s of each feature in its unit; 1 by default.
        seed: Seed of the default weights, normal with variance 1/inputs; biases are zero.
        max_weight: Maximum magnitude of weights and biases.
        parameters: The weights and then the bias of each unit, layer by layer, ``(..., P)``; named
            ``<unit>.<input>`` and ``<unit>.bias`` with hidden units ``h<layer>_<unit>``.
    """

    def __init__(
        self,
        observations: tuple[str, ...],
        actions: tuple[str, ...],
        limits: Sequence[tuple[float, float]],
        *,
        hidden: tuple[int, ...] = (8,),
        features: Features | None = None,
        scales: Sequence[float] | None = None,
        seed: int = 0,
        max_weight: float = 10.0,
        parameters: Tensor | None = None,
    ) -> None:
        inputs = feature_names(observations, features)
        scales = (1.0,) * len(inputs) if scales is None else tuple(scales)
        if len(limits) != len(actions) or len(scales) != len(inputs):
            raise ShapeError(
                f"{len(actions)} actions and {len(inputs)} features need as many limits and "
                f"scales, but got {len(limits)} limits and {len(scales)} scales."
            )
        self.observations = observations
        self.actions = actions
        self.features = features
        self.scales = scales
        self.centres = tuple(0.5 * (lower + upper) for lower, upper in limits)
        self.half_widths = tuple(0.5 * (upper - lower) for lower, upper in limits)
        hidden_names = [
            tuple(f"h{layer}_{unit}" for unit in range(size))
            for layer, size in enumerate(hidden, start=1)
        ]
        layers = [inputs, *hidden_names, actions]
        self.sizes = tuple(len(names) for names in layers)
        self.parameter_info = _parameter_info(layers, seed, max_weight)
        super().__init__(parameters)

    def constants(self, domain: Mapping[str, Tensor]) -> tuple[Units, ...]:
        """Returns the weights and biases, layer by layer."""
        counts = [(n + 1) * m for n, m in itertools.pairwise(self.sizes)]
        layers = self.parameters.split(counts, dim=-1)
        return tuple(units(p, m) for p, m in zip(layers, self.sizes[1:], strict=True))

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: tuple[Units, ...],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the commands."""
        features = observation if self.features is None else self.features(observation)
        values = tuple(x / scale for x, scale in zip(features, self.scales, strict=True))
        for layer in constants:
            values = tuple(torch.tanh(x) for x in affine(layer, values))
        commands = tuple(
            centre + half_width * x
            for centre, half_width, x in zip(self.centres, self.half_widths, values, strict=True)
        )
        return commands, memory


def _parameter_info(
    layers: Sequence[tuple[str, ...]], seed: int, max_weight: float
) -> tuple[PolicyParameter, ...]:
    """Names the weights and biases between layers of units, and draws their defaults."""
    generator = torch.Generator().manual_seed(seed)
    info = []
    for inputs, outputs in itertools.pairwise(layers):
        draws = torch.randn(len(outputs), len(inputs), generator=generator, dtype=torch.float64)
        draws = (draws / math.sqrt(len(inputs))).clamp(-max_weight, max_weight)
        for unit, weights in zip(outputs, draws.tolist(), strict=True):
            for name, default in zip((*inputs, "bias"), (*weights, 0.0), strict=True):
                info.append(PolicyParameter(f"{unit}.{name}", default, -max_weight, max_weight))
    return tuple(info)
