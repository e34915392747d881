"""Base class of methods with mixture density networks: proposals and their correction.

The first round's simulations come from the prior N(0, I), those of a later round r from a
proposal. This is the current posterior or the Gaussian with its moments. The mixture q(z | x) is
fitted to all simulations so far, each by the proposal posterior of its own round r(n),

    max sum_n log [q(z_n | x_n) t_r(n)(z_n) / Z_r(n)(x_n)],        t_r = p~_r / p,

which is known in closed form, see :mod:`npdr_ppl.inference.parts.mixtures.proposal_correction`. We
depart from Papamakarios & Murray (2016, Algorithm 2) in two points. First, they fit the term in
brackets as a free mixture and divide it by t_r afterwards. The quotient of two Gaussians need not
be a Gaussian, and then there is no posterior. We fit q by its product with t_r. This is the same
likelihood, restricted to mixtures whose quotient by t_r is a density, so there always is a
posterior. Second, they fit the last round only. We also use the earlier rounds, which determine q
where the last proposal has no draws, above all between the modes of a mixture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Density, Problem, Progress, State
from npdr_ppl.inference.parts.bases.neural_backend import (
    MIN_SIMULATIONS,
    NeuralBackend,
    NeuralState,
    Simulations,
)
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.mixtures.mixture_density import (
    MixtureDensityNetwork,
    mixture_at,
    perceptron,
)
from npdr_ppl.inference.parts.mixtures.proposal_correction import (
    PROPOSALS,
    correct_regression,
    proposal_of,
    tilt_forms,
    whiten_forms,
)
from npdr_ppl.inference.parts.training.embedding_network import build_embedding
from npdr_ppl.inference.parts.training.ensemble_training import Loss
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, refit_regression

__all__ = ["MixtureBackend", "ProposedSimulations"]

PROPOSAL_FIELDS = ("log_weights", "means", "precision_factors")


@dataclass(frozen=True)
class ProposedSimulations(Simulations):
    """Simulations with the proposals from which they were drawn.

    Attributes:
        proposals: The proposals of all rounds but the first, which used the prior.
    """

    proposals: tuple[GaussianMixture, ...] = ()

    def __getitem__(self, rows: Tensor) -> "ProposedSimulations":
        return replace(self, z=self.z[rows], x=self.x[rows], rounds=self.rounds[rows])

    def followed_by(self, z: Tensor, x: Tensor, number: int) -> "ProposedSimulations":
        """Returns these simulations and those of a round."""
        return _proposed(super().followed_by(z, x, number), self.proposals)


@dataclass(frozen=True)
class MixtureBackend(NeuralBackend):
    """A backend whose posterior is a mixture of Gaussians.

    Args:
        components: Number of components of every member's mixture.
        hidden: Widths of the hidden layers.
        proposals: Distribution from which later rounds draw: ``"gaussian"``, with the posterior's
            moments, or ``"mixture"``, the posterior itself.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.neural_backend.NeuralBackend`.
    """

    amortises: ClassVar[bool] = True

    batch_size: int = 128
    components: int = 5
    hidden: tuple[int, ...] = (64, 64)
    proposals: Literal["gaussian", "mixture"] = "gaussian"

    def __post_init__(self) -> None:
        """Validates the common options; a method adds its own."""
        super().__post_init__()
        self._check_at_least(1, "components")
        self._check_widths("hidden")
        self._check_choice("proposals", PROPOSALS)

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation."""
        state = super().init(problem)
        return replace(state, simulations=_proposed(state.simulations, ()))

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``.

        Raises:
            BackendError: There is a posterior to propose from, but the prior is not N(0, I).
        """
        if state.round == 0:
            return problem.sample_prior(num_simulations)
        return self._proposal(problem, state).sample(num_simulations)

    def learn(
        self, problem: Problem, state: NeuralState, z: Tensor, x: Tensor, progress: Progress
    ) -> tuple[NeuralState, dict[str, Any]]:
        """Trains the ensemble anew on the simulations so far; see :meth:`Backend.learn`."""
        if state.round:
            seen = self._seen(state)
            proposals = (*seen.proposals, self._proposal(problem, state))
            state = replace(state, simulations=replace(seen, proposals=proposals))
        return super().learn(problem, state, z, x, progress)

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""
        return [*self._posteriors(problem, state)]

    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values."""
        tensors, values = super().tensors(state)
        proposals = self._seen(self._own(state)).proposals
        for name in PROPOSAL_FIELDS if proposals else ():
            stack = torch.stack([getattr(proposal, name) for proposal in proposals])
            tensors[f"proposals.{name}"] = stack.contiguous()
        return tensors, values

    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> NeuralState:
        """Rebuilds a state from :meth:`tensors`; see :meth:`NeuralBackend.restore`."""
        state = super().restore(problem, tensors, values)
        stacks = [tensors.get(f"proposals.{name}", torch.empty(0)) for name in PROPOSAL_FIELDS]
        proposals = tuple(GaussianMixture(*parts) for parts in zip(*stacks, strict=True))
        return replace(state, simulations=_proposed(state.simulations, proposals))

    def _hidden(self, num_features: int) -> tuple[nn.Module, int]:
        """Returns the hidden layers of one network and their number of outputs."""
        return perceptron(num_features, self.hidden), self.hidden[-1]

    def _networks(self, problem: Problem) -> list[MixtureDensityNetwork]:
        networks = []
        for _ in range(self.members):
            embedding, num_features = build_embedding(
                problem.build_network, problem.observation.to("cpu", torch.float32)
            )
            hidden, num_hidden = self._hidden(num_features)
            networks.append(
                MixtureDensityNetwork(
                    problem.num_parameters, num_hidden, self.components, hidden, embedding
                )
            )
        return networks

    def _seen(self, state: NeuralState) -> ProposedSimulations:
        """Returns a state's simulations and their proposals.

        Raises:
            BackendError: It is the state of a backend that does not keep them.
        """
        if not isinstance(state.simulations, ProposedSimulations):
            raise BackendError(f"{self.name} cannot continue from another backend's state.")
        return state.simulations

    def _posteriors(self, problem: Problem, state: State) -> list[GaussianMixture]:
        """Returns the posterior of every ensemble member."""
        state, preconditioner = self._trained(state)
        preconditioner = preconditioner.to(problem.device)
        observation = problem.observation.to(problem.device, torch.float32)
        return [
            mixture_at(network, preconditioner, observation)
            for network in self._trained_networks(problem, state.weights)
        ]

    def _proposal(self, problem: Problem, state: State) -> GaussianMixture:
        """Returns the proposal of the round after a state."""
        if not problem.is_prior_standard_normal:
            raise BackendError(
                f"{self.name} corrects for proposals exactly only if the prior is N(0, I) in "
                "reference coordinates, and this model's is not; use one round, or snpe-c."
            )
        return proposal_of(self._posteriors(problem, state), self.proposals)

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        """Fits the regression to the last round and corrects it for that round's proposal."""
        preconditioner = super()._precondition(problem, simulations)
        # If nearly all simulations of a round failed, it is too small for a regression.
        sizes = torch.bincount(simulations.rounds).tolist()
        last = max(number for number, size in enumerate(sizes) if size >= MIN_SIMULATIONS)
        if last == 0 or problem.build_network is not None:
            return preconditioner
        rows = simulations[simulations.rounds == last]
        preconditioner = refit_regression(preconditioner, rows.z, rows.x)
        return correct_regression(preconditioner, _proposals(simulations)[last - 1])

    def _loss(
        self, problem: Problem, preconditioner: Preconditioner, simulations: Simulations
    ) -> Loss:
        """Returns the objective of the current round on the training device."""
        f = preconditioner.features(simulations.x.to(problem.device))
        z = simulations.z.to(problem.device)
        points = preconditioner.whiten(z, f)
        if simulations.rounds.any():
            points = torch.cat((points, self._tilts(preconditioner, simulations, f)), -1)
        return lambda log_prob, rows: -log_prob(points[rows], f[rows])

    def _tilts(
        self, preconditioner: Preconditioner, simulations: Simulations, f: Tensor
    ) -> Tensor:
        """Returns every row's quadratic forms in whitened parameters, ``(n, J (d + 1)^2)``."""
        forms = torch.stack([tilt_forms(proposal) for proposal in _proposals(simulations)])
        none = torch.zeros_like(forms[:1])  # for the prior: J terms of 1 / J each
        none[..., -1, -1] = 2 * torch.tensor(float(forms.shape[1])).log()
        by_row = torch.cat((none, forms)).to(f.device)[simulations.rounds.to(f.device)]
        shift = preconditioner.shift(f)
        return whiten_forms(by_row, preconditioner.factor, shift).flatten(1).to(f)


def _proposals(simulations: Simulations) -> tuple[GaussianMixture, ...]:
    """Returns the proposals of the simulations."""
    return simulations.proposals if isinstance(simulations, ProposedSimulations) else ()


def _proposed(
    simulations: Simulations, proposals: Sequence[GaussianMixture]
) -> ProposedSimulations:
    """Returns simulations with their proposals."""
    own = {field.name: getattr(simulations, field.name) for field in fields(Simulations)}
    return ProposedSimulations(**own, proposals=tuple(proposals))
