"""Recorded data as a target domain, for devices that are not available."""

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import shortened
from npdr_ppl.targets.base import Controller, TargetDomain

__all__ = ["RecordedTarget"]


class RecordedTarget(TargetDomain):
    """Returns recorded rollouts and ignores the controller.

    Args:
        rollouts: The recordings, one per episode.
        name: Name in tables and files.
    """

    is_recorded = True

    def __init__(self, rollouts: Rollouts, *, name: str = "recorded") -> None:
        self.name = name
        self.sensors = _channels(rollouts.channel_names, rollouts.channel_units)
        self.actions = _channels(rollouts.action_names, rollouts.action_units)
        self.time_step = rollouts.time_step
        self.num_episodes = len(rollouts)
        self._rollouts = rollouts

    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Returns the rollout of an episode, cut after ``num_steps`` steps.

        Args:
            controller: Ignored.
            num_steps: Maximum number of steps.
            episode: Index of the recording, from 0.
            seed: Ignored.

        Raises:
            DataError: There is no recording with this index.
        """
        if not 0 <= episode < len(self._rollouts):
            raise DataError(
                f"There are {len(self._rollouts)} recorded rollouts and no episode {episode}; "
                "record more, or ask for fewer iterations."
            )
        chosen = self._rollouts[episode]
        return shortened(chosen, num_steps)


def _channels(names: tuple[str, ...], units: tuple[str, ...]) -> tuple[Channel, ...]:
    return tuple(Channel(name, unit) for name, unit in zip(names, units, strict=True))
