"""Linear feedback on observations, or on features of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError
from npdr_ppl.policies.base import Policy, PolicyParameter

__all__ = ["AngleFeatures", "Features", "Linear", "Units", "affine", "feature_names", "units"]

Units = tuple[tuple[Tensor, ...], ...]
"""For each output its weights, then its bias. Each is a separate tensor, because loops flatten the
batch: a tensor with an axis for the inputs would not broadcast to the batch's shape."""


class Features(Protocol):
    """Functions of the observations that a policy uses instead of the observations."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features, in order."""
        ...

    def __call__(self, observation: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Returns the features, of the observations' shape."""
        ...


@dataclass(frozen=True)
class AngleFeatures:
    """Sine and cosine in place of each angle, so that full turns have no effect.

    Attributes:
        observations: Names of the policy's observations, in order.
        angles: Names of those that are angles, in rad.
    """

    observations: tuple[str, ...]
    angles: tuple[str, ...]

    def __post_init__(self) -> None:
        """Checks that every angle is observed."""
        missing = [angle for angle in self.angles if angle not in self.observations]
        if missing:
            raise ModelError(
                f"The angle {', '.join(missing)} is not among the observations "
                f"{', '.join(self.observations)}."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """``sin_<angle>`` and ``cos_<angle>``, and the other observations' own names."""
        names = []
        for name in self.observations:
            names += [f"sin_{name}", f"cos_{name}"] if name in self.angles else [name]
        return tuple(names)

    def __call__(self, observation: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Returns the features."""
        features = []
        for name, value in zip(self.observations, observation, strict=True):
            features += [value.sin(), value.cos()] if name in self.angles else [value]
        return tuple(features)


class Linear(Policy):
    """u_i = Σ_j K_ij φ_j(o) + b_i.

    Args:
        observations: Names of the sensor channels o.
        actions: Names of the A action channels.
        features: φ, F of them; ``None`` for the observations themselves.
        max_gain: Maximum magnitude of gains and biases.
        parameters: K row by row, each row followed by its b, shape ``(..., A (F + 1))``; named
            ``<action>.<feature>`` and ``<action>.bias``; zero by default.
    """

    def __init__(
        self,
        observations: tuple[str, ...],
        actions: tuple[str, ...],
        *,
        features: Features | None = None,
        max_gain: float = 100.0,
        parameters: Tensor | None = None,
    ) -> None:
        self.observations = observations
        self.actions = actions
        self.features = features
        names = (*feature_names(observations, features), "bias")
        self.parameter_info = tuple(
            PolicyParameter(f"{action}.{name}", 0.0, -max_gain, max_gain)
            for action in actions
            for name in names
        )
        super().__init__(parameters)

    def constants(self, domain: Mapping[str, Tensor]) -> Units:
        """Returns the gains and the bias of each action."""
        return units(self.parameters, len(self.actions))

    def act(
        self, observation: tuple[Tensor, ...], time: Tensor | float, memory: Any, constants: Units
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the commands."""
        features = observation if self.features is None else self.features(observation)
        return affine(constants, features), memory


def feature_names(observations: tuple[str, ...], features: Features | None) -> tuple[str, ...]:
    """Returns the names of the features, or the observations' own.

    Raises:
        ModelError: The features have more or fewer names than values.
    """
    if features is None:
        return observations
    num_values = len(features((torch.zeros(()),) * len(observations)))
    if num_values != len(features.names):
        raise ModelError(
            f"The features {', '.join(features.names)} have {len(features.names)} names, but "
            f"{num_values} values."
        )
    return features.names


def units(parameters: Tensor, num_outputs: int) -> Units:
    """Splits parameters, ``(..., outputs × (inputs + 1))``, into single tensors."""
    rows = parameters.unflatten(-1, (num_outputs, -1)).unbind(-2)
    return tuple(tuple(row.unbind(-1)) for row in rows)


def affine(units: Units, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Returns W x + b, one tensor per output.

    It is unrolled into one operation per weight, because the weights differ between the
    simulations of a batch. Compiled loops keep all values in registers.
    """
    outputs = []
    for *weights, total in units:
        for weight, value in zip(weights, inputs, strict=True):
            total = torch.addcmul(total, weight, value)
        outputs.append(total)
    return tuple(outputs)
