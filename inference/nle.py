"""NLE: neural likelihood estimation with normalising flows.

Papamakarios, Sterratt & Murray (2019), *Sequential Neural Likelihood*,
https://arxiv.org/abs/1805.07226, Algorithm 1. A conditional flow learns the density of the
features, max sum_n log q(x_n | z_n), over all rounds' simulations, whatever proposal they came
from; each round proposes draws of the present posterior, proportional to p(z) q(x_o | z).

The flow sees features as residuals of their ridge regression on the parameters' normal scores,
:mod:`npdr_ppl.inference.features` with the roles swapped: where x depends linearly on z with
Gaussian noise nothing is left to learn.
"""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.inference.base import Problem, State
from npdr_ppl.inference.features import Preconditioner, fit_preconditioner
from npdr_ppl.inference.flows import FLOWS, Flow, FlowNetwork, build_networks, load_member
from npdr_ppl.inference.likelihood import LearnedLogLikelihood, LikelihoodBackend
from npdr_ppl.inference.neural import NeuralState, Simulations
from npdr_ppl.inference.training import Loss

__all__ = ["NLE", "LikelihoodPreconditioner"]


@dataclass(frozen=True)
class LikelihoodPreconditioner(Preconditioner):
    """The preconditioner of features given parameters.

    Attributes:
        lowest: Least simulated value of each feature, ``(F,)``.
        highest: Greatest one.

    Beyond this range a flow extrapolates; features are clipped to it.
    """

    lowest: Tensor
    highest: Tensor


@dataclass(frozen=True)
class NLE(LikelihoodBackend):
    """Neural likelihood estimation; see the module's text for the method.

    Args:
        flow: Kind of flow, see :class:`~npdr_ppl.inference.flows.FlowNetwork`.
        transforms: Transforms of a flow.
        hidden: Widths of the hidden layers of each transform's conditioner.
        bins: Bins of a spline.

    The other options are those of :class:`~npdr_ppl.inference.neural.NeuralBackend`.
    """

    name: ClassVar[str] = "nle"
    summary: ClassVar[str] = "neural likelihood estimation with normalising flows, any prior later"

    preconditioner_type: ClassVar[type[Preconditioner]] = LikelihoodPreconditioner

    flow: Flow = "affine-nsf"
    batch_size: int = 256
    transforms: int = 3
    hidden: tuple[int, ...] = (128, 128)
    bins: int = 8

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_choice("flow", FLOWS)
        self._check_widths("hidden")
        self._check_ranges(transforms=(1, float("inf")), bins=(1, float("inf")))

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation.

        Raises:
            BackendError: The features are learnt jointly.
        """
        self._check_fixed_features(problem)
        return super().init(problem)

    def log_likelihoods(self, problem: Problem, state: State) -> list[LearnedLogLikelihood]:
        """Returns log q(x | z) of every ensemble member."""
        state, fitted = self._trained(state)
        assert isinstance(fitted, LikelihoodPreconditioner)
        preconditioner = fitted.to(problem.device)
        build = partial(self._networks, problem)

        def log_likelihood(network: FlowNetwork, z: Tensor, x: Tensor) -> Tensor:
            f = preconditioner.features(z.to(problem.device, torch.float32))
            x = x.to(problem.device).clamp(preconditioner.lowest, preconditioner.highest)
            u = preconditioner.whiten(x, f)
            return (network(u, f) + preconditioner.log_det).to(z)

        networks = [
            load_member(build, state.weights, k).to(problem.device) for k in range(self.members)
        ]
        return [partial(log_likelihood, network) for network in networks]

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        swapped = fit_preconditioner(simulations.x, simulations.z)
        x = simulations.x
        return LikelihoodPreconditioner(**swapped.tensors(), lowest=x.amin(0), highest=x.amax(0))

    def _outside(self, problem: Problem, preconditioner: Preconditioner) -> Tensor:
        assert isinstance(preconditioner, LikelihoodPreconditioner)
        x = problem.observation.cpu()
        return (x < preconditioner.lowest) | (x > preconditioner.highest)

    def _networks(self, problem: Problem) -> list[FlowNetwork]:
        return build_networks(
            self.members,
            problem.observation.numel(),
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
        f = preconditioner.features(simulations.z.to(problem.device))
        u = preconditioner.whiten(simulations.x.to(problem.device), f)
        return lambda log_prob, rows: -log_prob(u[rows], f[rows])
