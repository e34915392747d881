"""Requests for closed-loop episodes, and their results."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from npdr_ppl.engines.common.compilation import CompileMode
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.errors import ModelError
from npdr_ppl.language.simulator import Simulator

__all__ = ["EpisodeBatch", "EpisodeRequest", "Episodes", "FeedbackPolicy", "Reward"]

Reward = Callable[[Components, Components, Components], Tensor]
"""Maps positions and velocities at a step's start and its commands, before any limit, to the
reward of the step."""


class FeedbackPolicy(Protocol):
    """Interface of a policy for the loop; see :class:`npdr_ppl.policies.base.Policy`."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]
    parameters: Tensor

    def constants(self, domain: Mapping[str, Tensor]) -> Any:
        """Returns the constants for ``act``, computed once per episode."""
        ...

    def initial_memory(self, observation: tuple[Tensor, ...]) -> Any:
        """Returns the policy's own state at the start."""
        ...

    def act(
        self, observation: tuple[Tensor, ...], time: Tensor | float, memory: Any, constants: Any
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns commands and the next memory."""
        ...


@dataclass(frozen=True)
class Episodes:
    """Simulated episodes of a batch of shape B, broadcast over policies, domains and states.

    An episode ends after the step at which a state leaves its bounds; records are zero after it.

    Attributes:
        returns: Sum of rewards, ``B``; ``None`` without a reward.
        lengths: Steps until the episode ended, ``B``.
        readings: Measurements, including those at the start, ``B + (steps + 1, sensors)``;
            ``None`` unless recorded.
        commands: Commands before any limit, ``B + (steps, actions)``; ``None`` unless recorded.
    """

    returns: Tensor | None
    lengths: Tensor
    readings: Tensor | None = None
    commands: Tensor | None = None


class EpisodeBatch(NamedTuple):
    """Policies, domains and shape of a batch, of one floating type and on one device.

    Attributes:
        policy: The policies.
        domain: All parameters; those not given are nominal.
        shape: The batch's shape B, to which policies, domains and initial states broadcast.
    """

    policy: FeedbackPolicy
    domain: dict[str, Tensor]
    shape: torch.Size


@dataclass(frozen=True)
class EpisodeRequest:
    """Request to an engine to run episodes.

    The attributes are the arguments of
    :meth:`~npdr_ppl.engines.common.closed_loop_simulator.ClosedLoopSimulator.roll_out`.
    """

    parameters: Mapping[str, Tensor]
    policy: FeedbackPolicy
    initial_states: Tensor
    num_steps: int
    reward: Reward | None
    time_step: float
    record: bool
    compile: CompileMode | None
    expected_calls: int
    internal_model: Mapping[str, float] | None = None

    def believed(self, domain: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the parameters that the policy's own model assumes in a domain."""
        given = self.internal_model or {}
        like = next(iter(domain.values()), self.initial_states)
        return {**domain, **{name: like.new_tensor(value) for name, value in given.items()}}

    def check(self, simulator: Simulator) -> None:
        """Raises a ModelError if parameters or channels are not the simulator's."""
        simulator.check_parameters(self.parameters)
        sensors = [sensor.name for sensor in simulator.sensors]
        missing = [name for name in self.policy.observations if name not in sensors]
        missing += [a.name for a in simulator.actions if a.name not in self.policy.actions]
        if missing:
            raise ModelError(
                f"{type(self.policy).__name__} and {simulator.name} do not fit together: "
                f"{', '.join(missing)} is on one side only."
            )

    def batch(
        self, simulator: Simulator, dtype: torch.dtype, device: torch.device
    ) -> EpisodeBatch:
        """Returns policies and domains with the type and on the device of the engine."""
        policy = copy.copy(self.policy)
        policy.parameters = policy.parameters.to(dtype=dtype, device=device)
        domain = simulator.complete(self.parameters, dtype, device)
        shape = torch.broadcast_shapes(
            *(value.shape for value in domain.values()),
            policy.parameters.shape[:-1],
            self.initial_states.shape[:-1],
        )
        return EpisodeBatch(policy, domain, shape)
