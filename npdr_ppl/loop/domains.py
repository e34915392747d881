"""Domains: a simulator with many parameter sets, drawn from a prior or a posterior.

``training_domains.py`` calls this module to make those in which a policy is trained.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.rollouts import Rollouts

if TYPE_CHECKING:
    from npdr_ppl.posterior.posterior import PosteriorBase

__all__ = ["Domains", "domains_at", "most_likely_domain", "prior_of", "simulator_of"]


@dataclass(frozen=True)
class Domains:
    """One simulator with D parameter sets.

    Attributes:
        simulator: The simulator with its effects.
        parameters: Parameters of simulator and effects by name, ``(D,)`` each, in their units;
            missing ones are nominal.
    """

    simulator: ClosedLoopSimulator
    parameters: Mapping[str, Tensor]

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    def spread(self, share: float, generator: torch.Generator) -> "Domains":
        """Multiplies every parameter of every domain by a number uniform in 1 ± ``share``.

        A policy trained on a point estimate is not robust, even if the estimate is exact.
        """
        return Domains(
            self.simulator,
            {
                name: value
                * (1.0 + share * (2.0 * torch.rand(value.shape, generator=generator) - 1.0))
                for name, value in self.parameters.items()
            },
        )

    def followed_by(self, others: "Domains") -> "Domains":
        """Returns these domains together with others of the same simulator."""
        return Domains(
            self.simulator,
            {k: torch.cat((v, others.parameters[k])) for k, v in self.parameters.items()},
        )


def prior_of(
    model: Model,
    sensors: tuple[Channel, ...],
    actions: tuple[Channel, ...],
    time_step: float,
) -> Prior:
    """Returns the prior of a model when there is no measurement yet.

    A model needs inputs, so it gets those of a device at rest for one step.

    Args:
        model: The Pyro model.
        sensors: Channels of the device's measurements.
        actions: Channels of its commands.
        time_step: Seconds per step.
    """
    at_rest = Rollouts.from_arrays(
        readings=np.zeros((1, 2, len(sensors))),
        actions=np.zeros((1, 1, len(actions))),
        channel_names=[channel.name for channel in sensors],
        action_names=[channel.name for channel in actions],
        time_step=time_step,
    )
    return Prior(model, (at_rest.inputs(None, "recorded"),))


def simulator_of(prior: Prior) -> ClosedLoopSimulator:
    """Returns the simulator of a model's only black-box site, with its effects attached.

    Raises:
        ModelError: There are several sites, or the simulator cannot run policies in batches.
    """
    if len(prior.black_boxes) != 1:
        raise ModelError(
            f"Policies are trained on models with one black-box site; this one has "
            f"{len(prior.black_boxes)}."
        )
    (box,) = prior.black_boxes.values()
    if not isinstance(box, SimulatorBlackBox) or not isinstance(
        box.simulator, ClosedLoopSimulator
    ):
        raise ModelError(
            "Policies are trained in simulators with batched closed-loop rollouts "
            f"(ClosedLoopSimulator); site {box.site!r} has none."
        )
    return box.simulator


def domains_at(prior: Prior, z: Tensor) -> Domains:
    """Converts points in reference coordinates to domains of a model.

    Args:
        prior: The model's prior.
        z: Points, ``(D, d)``.

    Raises:
        ModelError: The model's parameters differ within a simulation; see :func:`simulator_of`.
    """
    simulator = simulator_of(prior)
    (box,) = prior.black_boxes_at(z).values()
    parameters = {}
    for name, value in box.parameters.items():
        if value.numel() not in (1, len(z)):
            raise ModelError(
                f"Parameter {name} has the shape {tuple(value.shape)} for {len(z)} domains; "
                "policies are trained on models without plates."
            )
        parameters[name] = value.reshape(-1).expand(len(z))
    return Domains(simulator, parameters)


def most_likely_domain(posterior: "PosteriorBase", *, seed: int) -> dict[str, float]:
    """Returns the simulator's parameters at the most likely sample, for an internal model."""
    prior = posterior.prior
    values = {name: value[None] for name, value in posterior.most_likely(seed=seed).items()}
    domain = domains_at(prior, prior.to_reference(values))
    return {name: float(value[0]) for name, value in domain.parameters.items()}
