"""Simulators that run policies in closed loop, in batches."""

from abc import abstractmethod
from collections.abc import Mapping

from torch import Tensor

from npdr_ppl.engines.common.compilation import CompileMode
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes, FeedbackPolicy, Reward
from npdr_ppl.language.simulator import Simulator

__all__ = ["ClosedLoopSimulator"]


class ClosedLoopSimulator(Simulator):
    """A simulator in which policies can be trained."""

    def roll_out(
        self,
        parameters: Mapping[str, Tensor],
        policy: FeedbackPolicy,
        initial_states: Tensor,
        num_steps: int,
        *,
        reward: Reward | None = None,
        time_step: float | None = None,
        record: bool = False,
        compile: CompileMode | None = None,
        expected_calls: int = 1,
        internal_model: Mapping[str, float] | None = None,
    ) -> Episodes:
        """Simulates closed-loop episodes of a batch of policies, domains and initial states.

        The three broadcast to the batch shape B: keep policies on one axis, domains on another and
        states on a third. Commands are limited to the channels' bounds and then pass the action
        effects. Policies receive measurements; the first measurement has no errors. Commands
        before the start are zero, but servos hold their first goals.

        Args:
            parameters: Domain and effect parameters; missing ones are nominal.
            policy: The policies; ``policy.parameters`` has the shape ``(..., parameters)``.
            initial_states: True states at the start, ``(..., states)``.
            num_steps: Greatest number of steps.
            reward: Reward of a step.
            time_step: Seconds per step; ``None`` for the simulator's.
            record: Whether to return measurements and commands; recording is not compiled.
            compile: Replaces the simulator's choice; engines that are compiled already ignore it.
            expected_calls: Number of calls of this size to expect; ``auto`` then decides whether
                compilation saves time.
            internal_model: Parameters that the policies' own model has in every domain, as on a
                device with unknown parameters; ``None`` for the parameters of each domain.

        Raises:
            ModelError: A parameter is unknown, or the policy's channels are not the simulator's.
        """
        request = EpisodeRequest(
            parameters,
            policy,
            initial_states,
            num_steps,
            reward,
            time_step or self.time_step,
            record,
            compile,
            expected_calls,
            internal_model,
        )
        request.check(self)
        return self.run_episodes(request)

    @abstractmethod
    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates the episodes of a checked request; see :meth:`roll_out`."""
