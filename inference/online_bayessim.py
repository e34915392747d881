"""Online BayesSim: BayesSim whose networks are trained further in every round.

Possas, Barcelos, Oliveira, Fox & Ramos (2020), *Online BayesSim for combined simulator parameter
inference and policy improvement*, IROS. Inference of the simulator's parameters alternates with
improvement of the controller. Each time, simulations are drawn from the current posterior, and the
network is trained further on them. Here a round

1. draws from the current posterior, or from the prior in the first round,
2. continues training the previous round's networks for a few epochs; it keeps the first round's
   preconditioner, because the weights are valid only with it,
3. corrects for the proposals as :mod:`npdr_ppl.inference.parts.bases.mixture_backend` describes.
   Unlike the paper, we keep the earlier simulations, each with its own proposal.

This file does not improve the controller. A loop that does so reads ``continues`` and starts each
iteration from the last iteration's posterior, whereas BayesSim starts from the prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.bayessim import BayesSim
from npdr_ppl.inference.parts.bases.neural_backend import NeuralState, Simulations
from npdr_ppl.inference.parts.mixtures.mixture_density import MixtureDensityNetwork
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, fit_preconditioner

__all__ = ["OnlineBayesSim"]


@dataclass(frozen=True)
class OnlineBayesSim(BayesSim):
    """Online BayesSim; see the module's text for the method.

    The options are those of :class:`~npdr_ppl.inference.bayessim.BayesSim`; ``epochs`` is the
    number per round.
    """

    name: ClassVar[str] = "online-bayessim"
    summary: ClassVar[str] = "BayesSim that continues from its last posterior and networks"
    continues: ClassVar[bool] = True

    epochs: int = 10
    learning_rate: float = 3e-3

    def _precondition(self, problem: Problem, simulations: Simulations) -> Preconditioner:
        """Returns the first round's preconditioner."""
        first = simulations[simulations.rounds == 0]
        return fit_preconditioner(first.z, first.x, problem.build_network is not None)

    def _starting_networks(
        self,
        problem: Problem,
        state: NeuralState,
        preconditioner: Preconditioner,
        simulations: Simulations,
    ) -> Sequence[MixtureDensityNetwork]:
        """Returns the networks of the previous round."""
        if state.round == 0:
            return super()._starting_networks(problem, state, preconditioner, simulations)
        networks = self._trained_networks(problem, state.weights)
        return [network.requires_grad_(True) for network in networks]
