"""NLE: neural likelihood estimation with normalising flows.

Papamakarios, Sterratt & Murray (2019), *Sequential Neural Likelihood*,
https://arxiv.org/abs/1805.07226, Algorithm 1. A conditional flow learns the density of the
features, max sum_n log q(x_n | z_n), from the simulations of all rounds and all proposals. Each
round proposes draws of the current posterior, proportional to p(z) q(x_o | z).

The features' normal scores s are regressed on a polynomial m of the parameters. The degree of m is
the one with the least leave-one-out error. The input of the flow is the whitened residuals u =
L^-1 (s(x) - m(z)). Where x is a smooth function of z with Gaussian noise, as the measurements of a
deterministic simulator are, little is left to learn.

If there are many features, such as the measurements of a trajectory, the flow gets a few
combinations of them. They are those that vary most with the parameters, in units of their scatter
at given parameters (Fisher's linear discriminants). With noise that is Gaussian and the same for
all parameters, combinations that span E[x | z] are a sufficient statistic.
"""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, get_args

import torch
from torch import Tensor

from npdr_ppl.inference.base import Problem, State
from npdr_ppl.inference.parts.bases.likelihood_backend import (
    LearnedLogLikelihood,
    LikelihoodBackend,
)
from npdr_ppl.inference.parts.bases.neural_backend import Simulations
from npdr_ppl.inference.parts.flows.flows import (
    FLOWS,
    Flow,
    FlowNetwork,
    build_networks,
)
from npdr_ppl.inference.parts.training.ensemble_training import Loss
from npdr_ppl.inference.parts.training.likelihood_preconditioning import (
    LikelihoodPreconditioner,
    fit_likelihood_preconditioner,
)
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = ["NLE"]

Coordinates = Literal["normal", "bounded"]


@dataclass(frozen=True)
class NLE(LikelihoodBackend):
    """Neural likelihood estimation; see the module's text for the method.

    Args:
        flow: Kind of flow, see :class:`~npdr_ppl.inference.parts.flows.flows.FlowNetwork`.
        transforms: Number of transforms of a flow.
        hidden: Widths of the hidden layers of each transform's conditioner.
        bins: Number of bins of a spline.
        max_features: Maximum number of combinations of the features that the flow gets.
        coordinates: ``"normal"``, in which every prior is standard normal, or ``"bounded"``, Phi
            of them, in which uniform priors are uniform. In normal coordinates a parameter near
            the end of its range hardly changes, so its effect there is learnt badly. Choose
            bounded ones where a posterior, above all a hierarchical one, reaches the ends of
            uniform ranges.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.neural_backend.NeuralBackend`.
    """

    name: ClassVar[str] = "nle"
    summary: ClassVar[str] = "neural likelihood estimation with normalising flows, any prior later"

    preconditioner_type: ClassVar[type[Preconditioner]] = LikelihoodPreconditioner

    members: int = 1
    epochs: int = 20
    flow: Flow = "affine-nsf"
    transforms: int = 3
    hidden: tuple[int, ...] = (128, 128)
    bins: int = 8
    max_features: int = 16
    coordinates: Coordinates = "normal"

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_choice("flow", FLOWS)
        self._check_choice("coordinates", get_args(Coordinates))
        self._check_widths("hidden")
        self._check_at_least(1, "transforms", "bins", "max_features")

    def log_likelihoods(self, problem: Problem, state: State) -> list[LearnedLogLikelihood]:
        """Returns log q(x | z) of every ensemble member."""
        state, fitted = self._trained(state)
        assert isinstance(fitted, LikelihoodPreconditioner)
        preconditioner = fitted.to(problem.device)

        def log_likelihood(network: FlowNetwork, z: Tensor, x: Tensor) -> Tensor:
            f = preconditioner.features(z.to(problem.device, torch.float32))
            u = preconditioner.whiten(preconditioner.statistics(x.to(problem.device)), f)
            return (network(u, f) + preconditioner.log_det).to(z)

        networks = self._trained_networks(problem, state.weights)
        return [partial(log_likelihood, network) for network in networks]

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        is_bounded = self.coordinates == "bounded"
        return fit_likelihood_preconditioner(
            simulations.z, simulations.x, self.max_features, is_bounded=is_bounded
        )

    def _outside(self, problem: Problem, preconditioner: Preconditioner) -> Tensor:
        assert isinstance(preconditioner, LikelihoodPreconditioner)
        x = problem.observation.cpu()
        knots = preconditioner.feature_knots
        return (x < knots[:, 0]) | (x > knots[:, -1])

    def _networks(self, problem: Problem) -> list[FlowNetwork]:
        return build_networks(
            self.members,
            min(problem.observation.numel(), self.max_features),
            torch.zeros(problem.num_parameters),
            None,
            self.flow,
            self.transforms,
            self.hidden,
            self.bins,
        )

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        assert isinstance(preconditioner, LikelihoodPreconditioner)
        f = preconditioner.features(simulations.z.to(problem.device))
        x = preconditioner.statistics(simulations.x.to(problem.device))
        u = preconditioner.whiten(x, f)
        return lambda log_prob, rows: -log_prob(u[rows], f[rows])
