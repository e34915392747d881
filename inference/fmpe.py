"""FMPE: flow-matching posterior estimation.

Wildberger, Dax, Buchholz, Green, Macke & Schoelkopf (2023), *Flow matching for scalable
simulation-based inference*, https://arxiv.org/abs/2305.17161, after Lipman, Chen, Ben-Hamu, Nickel
& Le (2023), *Flow matching for generative modeling*, https://arxiv.org/abs/2210.02747. The
posterior is the distribution of the end point of an ordinary differential equation that starts
from the standard normal. Its velocity is a network, trained by regression on a conditional
velocity that is known in closed form.

On the optimal-transport path (Lipman et al., Eq. 22; Wildberger et al., Eq. 6) noise u_0 ~ N(0, I)
goes to parameters u_1 as

    u_t = (1 - (1 - sigma) t) u_0 + t u_1,        0 <= t <= 1.

We scale that path to unit variance and measure time by an angle. With tan(phi) = t / (1 - (1 -
sigma) t) and y = u_t / r, r^2 = (1 - (1 - sigma) t)^2 + t^2, it becomes

    y_phi = cos(phi) u_0 + sin(phi) u_1,        dy/dphi = cos(phi) u_1 - sin(phi) u_0,

and for small sigma the paper's loss with t uniform is, term by term, the loss

    E || v(y_phi, phi, f) - cos(phi) u_1 + sin(phi) u_0 ||^2

with phi uniform: the factor r^2 between the two errors cancels dphi/dt. This has two advantages.
The target has the same scale at all times, and a zero velocity is right wherever u_1 given f is
N(0, I). For linear-Gaussian problems the preconditioner
(:mod:`npdr_ppl.inference.parts.training.preconditioning`) ensures the latter. A network that
starts at zero therefore starts at that posterior, and the solver's steps are needed for the
non-Gaussian part only.

Sequential rounds use truncated proposals, see :mod:`npdr_ppl.inference.parts.bases.truncated`.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.parts.bases.neural_backend import Simulations
from npdr_ppl.inference.parts.bases.truncated import TruncatedBackend
from npdr_ppl.inference.parts.flows.velocity import VelocityDensity, VelocityNetwork, end_angle
from npdr_ppl.inference.parts.training.embedding_network import build_embedding
from npdr_ppl.inference.parts.training.ensemble_training import LogProb, Loss
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner
from npdr_ppl.randomness import seeded

__all__ = ["FMPE", "flow_matching_loss"]

VALIDATION_DRAWS = 8
"""Noise draws and angles per held-out row at which the loss is evaluated; the same in every
epoch."""


@dataclass(frozen=True)
class FMPE(TruncatedBackend):
    """Flow-matching posterior estimation; see the module's text for the method.

    Args:
        hidden: Width of the velocity network's two residual blocks.
        context: Width of the network that turns features and time into the blocks' modulation.
        draws: Noise draws and angles per row and training step.
        sigma: Standard deviation sigma of the noise that is left at the end of the path, in units
            of the preconditioned parameters.
        steps: Number of steps of the solver.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.truncated.TruncatedBackend`.
    """

    name: ClassVar[str] = "fmpe"
    summary: ClassVar[str] = "flow-matching posterior estimation"
    objective: ClassVar[str] = "validation_flow_matching"
    amortises: ClassVar[bool] = True

    members: int = 1
    epochs: int = 20
    batch_size: int = 256
    learning_rate: float = 1e-2
    hidden: int = 48
    context: int = 96
    draws: int = 4
    sigma: float = 0.01
    steps: int = 10

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_at_least(1, "hidden", "context", "draws", "steps")
        self._check_ranges(sigma=(1e-4, 0.5))

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""
        state, preconditioner = self._trained(state)
        preconditioner = preconditioner.to(problem.device)
        observation = problem.observation.to(problem.device, torch.float32)
        return [
            VelocityDensity(network, preconditioner, observation, self.sigma, self.steps)
            for network in self._trained_networks(problem, state.weights)
        ]

    def _networks(self, problem: Problem) -> list[VelocityNetwork]:
        observation = problem.observation.to("cpu", torch.float32)
        networks = []
        for _ in range(self.members):
            embedding, num_features = build_embedding(problem.build_network, observation)
            networks.append(
                VelocityNetwork(
                    problem.num_parameters,
                    num_features,
                    embedding,
                    self.hidden,
                    self.context,
                )
            )
        return networks

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective of the current round on the training device."""
        f = preconditioner.features(simulations.x.to(problem.device))
        u = preconditioner.whiten(simulations.z.to(problem.device), f)

        def loss(velocity: LogProb, rows: Tensor) -> Tensor:
            # Angles of a row are stratified: each lies in its own part of the path.
            shape = (*rows.shape, self.draws)
            part = (torch.rand(shape) + torch.arange(self.draws)) / self.draws
            noise = torch.randn(*shape, u.shape[-1])
            return flow_matching_loss(
                velocity, u[rows], f[rows], noise.to(u), end_angle(self.sigma) * part.to(u)
            )

        return loss

    def _validation_loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective with the same noise in every epoch."""
        f = preconditioner.features(simulations.x.to(problem.device))
        u = preconditioner.whiten(simulations.z.to(problem.device), f)

        def loss(velocity: LogProb, rows: Tensor) -> Tensor:
            shape = (*rows.shape, VALIDATION_DRAWS)
            with seeded(0, "held-out noise"):
                noise = torch.randn(*shape, u.shape[-1])
                part = (torch.rand(shape) + torch.arange(VALIDATION_DRAWS)) / VALIDATION_DRAWS
            return flow_matching_loss(
                velocity, u[rows], f[rows], noise.to(u), end_angle(self.sigma) * part.to(u)
            )

        return loss

    def _objective(self, validation: Tensor, preconditioner: Preconditioner) -> Tensor:
        """Returns the validation objective, which has no units."""
        return validation


def flow_matching_loss(
    velocity: LogProb, u: Tensor, f: Tensor, noise: Tensor, angle: Tensor
) -> Tensor:
    """Returns the squared error of the velocity, averaged over a row's noise draws.

    Args:
        velocity: Velocities of all members at points y and angles phi, ``(members, n, k, d + 1)``,
            and features ``(members, n, ...)``.
        u: Preconditioned parameters u_1, ``(members, n, d)``.
        f: Standardised features, ``(members, n, ...)``.
        noise: Noise u_0, ``(members, n, k, d)``.
        angle: Angles phi, ``(members, n, k)``.

    Returns:
        The loss of each row, ``(members, n)``.
    """
    cos, sin = angle.cos()[..., None], angle.sin()[..., None]
    u = u[..., None, :]
    points = torch.cat((cos * noise + sin * u, angle[..., None]), -1)
    target = cos * u - sin * noise
    return (velocity(points, f) - target).square().sum(-1).mean(-1)
