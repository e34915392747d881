"""Batched simulation of mechanical systems whose accelerations are written in torch."""

import copy
from collections.abc import Mapping
from typing import Self

from torch import Tensor

from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.integrators import integrator
from npdr_ppl.engines.ode.mechanical_system import Forces, MechanicalSystem
from npdr_ppl.engines.ode.policy_episodes import roll_out
from npdr_ppl.engines.ode.recorded_actions import replay
from npdr_ppl.language.inputs import Inputs

__all__ = ["Forces", "ODESimulator"]

FINER = "midpoint", "rk4"
"""Integrators of :meth:`ODESimulator.with_finer_steps`, in order of use. At the time steps of the
included models, the error of the first is a hundredth of that of an Euler step, which is mostly
negligible, and it takes half the time of the second."""


class ODESimulator(MechanicalSystem):
    """Simulates the system that a subclass declares; see :class:`MechanicalSystem`.

    Computations use the widest floating type among the given parameters and the inputs' actions,
    on the device of the actions.
    """

    def with_finer_steps(self) -> Self | None:
        """Returns a copy with the next integrator of higher order; ``None`` if there is none."""
        for finer in map(integrator, FINER):
            if finer.order > self.integrator.order:
                changed = copy.copy(self)
                changed.integrator = finer
                return changed
        return None

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions; see :meth:`Simulator.simulate`."""
        return replay(self, parameters, inputs)

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`ClosedLoopSimulator.roll_out`."""
        return roll_out(self, request)
