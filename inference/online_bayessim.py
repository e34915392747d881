"""Online BayesSim: BayesSim whose network goes on learning from one posterior to the next.

Possas, Barcelos, Oliveira, Fox & Ramos (2020), *Online BayesSim for combined simulator parameter
inference and policy improvement*, IROS. Learning about the simulator's parameters alternates with
improving the controller: every time, simulations are drawn from the present posterior, and the
network is trained further on them. Here a round

1. draws from the present posterior, the prior at first,
2. goes on from the networks of the round before, for few epochs, with the
   first round's preconditioner, without which their weights would lose their meaning,
3. corrects for the proposals as :mod:`npdr_ppl.inference.parts.bases.mixture_backend`
describes; by keeping
   the earlier simulations, each with its own proposal, we depart from the paper.

The controller is not this file's business; ``continues`` tells a loop that has one to go on from
the posterior of its last iteration, where BayesSim goes back to the prior.
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

    The options are those of :class:`~npdr_ppl.inference.bayessim.BayesSim`; ``epochs`` are those
    of one round.
    """

    name: ClassVar[str] = "online-bayessim"
    summary: ClassVar[str] = "BayesSim that goes on from its last posterior and networks"
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
        """Returns the networks of the round before."""
        if state.round == 0:
            return super()._starting_networks(problem, state, preconditioner, simulations)
        return self._trained_networks(problem, state)
