"""The base class of policies: a batched feedback law with named, bounded parameters."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import ShapeError

__all__ = ["Policy", "PolicyParameter"]


@dataclass(frozen=True)
class PolicyParameter:
    """A number that policy search may change.

    Attributes:
        name: Name in tables and files.
        default: Value to start from.
        lower: Least sensible value.
        upper: Greatest sensible value.
    """

    name: str
    default: float
    lower: float = -math.inf
    upper: float = math.inf


class Policy(ABC):
    """Maps observations to commands, for batches of policies and domains at once.

    The parameters of a batch of policies are one tensor. Its leading dimensions broadcast against
    those of the domains and of the initial states, so keep policies on their own axis.

    Args:
        parameters: Values, shape ``(..., len(parameter_info))``; ``None`` for the defaults.

    Attributes:
        observations: Names of the sensor channels that the policy reads.
        actions: Names of the action channels that it commands.
        parameter_info: Names, defaults and bounds of its parameters. If their number depends on
            the instance, set it before this constructor runs.
        parameters: The values.
    """

    observations: tuple[str, ...]
    actions: tuple[str, ...]
    parameter_info: tuple[PolicyParameter, ...] = ()
    parameters: Tensor

    def __init__(self, parameters: Tensor | None = None) -> None:
        if parameters is None:
            parameters = torch.tensor([info.default for info in self.parameter_info])
        if parameters.shape[-1:] != (len(self.parameter_info),):
            raise ShapeError(
                f"{type(self).__name__} has {len(self.parameter_info)} parameters, but the "
                f"vector has {parameters.shape=}."
            )
        self.parameters = parameters

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(info.name for info in self.parameter_info)

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and greatest values of the parameters, ``(len(parameter_info),)`` each."""
        lower = torch.tensor([info.lower for info in self.parameter_info])
        return lower, torch.tensor([info.upper for info in self.parameter_info])

    def with_parameters(self, parameters: Tensor) -> Self:
        """Returns the same policy with other parameters, ``(..., len(parameter_info))``."""
        changed = copy.copy(self)
        Policy.__init__(changed, parameters)
        return changed

    def constants(self, domain: Mapping[str, Tensor]) -> Any:
        """Returns what :meth:`act` needs, computed once per episode.

        The result is any nesting of tuples and dictionaries of tensors; by default the parameters
        by name.

        Args:
            domain: Domain parameters of the episodes, for policies with an internal model.
        """
        return dict(zip(self.names, self.parameters.unbind(-1), strict=True))

    def initial_memory(self, observation: tuple[Tensor, ...]) -> Any:
        """Returns the policy's own state at the start of an episode; ``None`` if it has none."""
        return None

    def controller(
        self, domain: Mapping[str, Tensor]
    ) -> Callable[[NDArray[np.float64], float], NDArray[np.float64]]:
        """Returns one policy as a function of measurements and time, for devices and engines.

        The function keeps the policy's memory, so use it for one episode only.

        Args:
            domain: Domain parameters for the policy's internal model.

        Returns:
            Function of the observed measurements, ``(observations,)``, and of the time in seconds.
            It returns the commands in the order of ``actions``, ``(actions,)``, before any limit.
        """
        constants = self.constants(domain)
        memory: list[Any] = []

        def command(readings: NDArray[np.float64], time: float) -> NDArray[np.float64]:
            observation = torch.as_tensor(readings, dtype=self.parameters.dtype).unbind()
            if not memory:
                memory.append(self.initial_memory(observation))
            with torch.no_grad():
                chosen, memory[0] = self.act(observation, time, memory[0], constants)
            return np.asarray([float(value) for value in chosen])

        return command

    @abstractmethod
    def act(
        self, observation: tuple[Tensor, ...], time: Tensor | float, memory: Any, constants: Any
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the commands of a step, before any limit, and the next memory.

        Everything that varies between episodes is an argument. This method must not use
        ``parameters``, because one compiled loop serves all policies.

        Args:
            observation: One tensor per observed channel, of the batch's shape.
            time: Seconds since the episode's start.
            memory: The policy's own state.
            constants: What :meth:`constants` returned.
        """
