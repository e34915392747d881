"""The real rollouts of one run of the loop: how many there are, and how many are left."""

from collections.abc import Mapping

from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.policies.base import Policy
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import TargetDomain

__all__ = ["LoopRollouts"]


class LoopRollouts:
    """Records episodes and counts them.

    Args:
        real: Runs policies on the target.
        options: Options of the loop.
        seed: Seed of the run.
    """

    def __init__(self, real: RealRollouts, options: LoopOptions, seed: int) -> None:
        self.real = real
        self.options = options
        self.seed = seed
        self._rollouts: list[Rollouts] = []

    def __len__(self) -> int:
        return len(self._rollouts)

    @property
    def target(self) -> TargetDomain:
        """The target domain."""
        return self.real.target

    @property
    def num_steps(self) -> int:
        """Total number of steps in all rollouts."""
        return sum(sum(rollout.lengths) for rollout in self._rollouts)

    def can_collect(self, number: int) -> bool:
        """Returns whether the target has at least this number of episodes left."""
        limit = self.target.num_episodes
        return limit is None or len(self) + number <= limit

    def extra_left(self, index: int) -> int:
        """Returns how many extra episodes are left in an iteration."""
        used = len(self) - self.options.rollouts * (index + 1)
        left = self.options.extra_rollouts - used
        return left if self.can_collect(1) else 0

    def collect(self, policy: Policy, domain: Mapping[str, float]) -> Rollouts:
        """Runs the next episode on the target, or reads it if it is on disk.

        Args:
            policy: The policy to run.
            domain: Parameters of its internal model.
        """
        episode = len(self)
        seed = derived_seed(self.seed, "episode", episode)
        self._rollouts.append(self.real.collect(episode, policy, domain, seed=seed))
        return self._rollouts[-1]

    def joined(self, number: int | None = None) -> Rollouts:
        """Returns the last rollouts as one set; all of them if no number is given."""
        first, *others = self._rollouts[-(number or len(self)) :]
        return first.concatenate(*others) if others else first
