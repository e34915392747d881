"""Simulators on workers in which policies run, because they can stop after each step."""

from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.pooled.pooled_closed_loop import roll_out
from npdr_ppl.engines.pooled.steppable_simulator import Simulation, SteppableSimulator

__all__ = ["Simulation", "SteppedSimulator"]


class SteppedSimulator(SteppableSimulator):
    """A simulator that receives one segment at a time and can stop after each step.

    A subclass writes :meth:`begin` instead of :meth:`simulate_one`. In closed loop, every episode
    is one draw; the worker evaluates policy, reward and effects. The return of an episode that
    finally failed is NaN, and its length is 0. All states must be among the sensors, because
    reward and bounds need them.
    """

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`ClosedLoopSimulator.roll_out`.

        The arguments for compilation have no effect.
        """
        return roll_out(self, request)
