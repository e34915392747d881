"""What a target domain is: something that runs a controller and hands back what it recorded."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from npdr_ppl.errors import NpdrError, ShapeError
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.rollout_checks import MAX_MAGNITUDE

__all__ = ["Array", "Controller", "TargetDomain", "TargetError", "end_episode", "partial_rollout"]

Array = NDArray[np.float64]

Controller = Callable[[Array, float], Array]
"""Maps readings ``(sensors,)``, in the order of the target's sensors, and the time since the
episode's start in s to commands ``(actions,)``, before any limit."""


class TargetError(NpdrError, RuntimeError):
    """A target domain cannot go on, and a person should look at it."""


class TargetDomain(ABC):
    """The real device of the policy loop: a rig, another engine, or recorded data.

    A target knows nothing of models, posteriors and rewards of ours, and whoever holds one sees
    its channels and its recordings only: parameters that it may have are private.

    Attributes:
        name: Name in tables and files.
        sensors: Channels of the readings, with units and the bounds of safe operation.
        actions: Channels of the commands, with the limits that the target applies.
        time_step: Seconds between commands.
        is_recorded: Whether episodes were recorded beforehand, so that controllers are ignored.
        num_episodes: How many episodes there are; ``None`` for as many as wanted.
    """

    name: str
    sensors: tuple[Channel, ...]
    actions: tuple[Channel, ...]
    time_step: float
    is_recorded: bool = False
    num_episodes: int | None = None

    @abstractmethod
    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Runs one episode from the target's own distribution of initial states.

        The controller may carry memory, so it serves one episode. What takes time after the last
        reading (homing, disconnecting) follows :func:`end_episode`. An exception that ends the
        episode carries what was recorded until then where that is worth keeping; see
        :func:`partial_rollout`.

        Args:
            controller: What commands the target.
            num_steps: Greatest number of steps; episodes that leave the bounds are shorter.
            episode: Number of the episode in the caller's run, from 0; tells recordings apart.
            seed: Seed of everything random: a simulated target repeats an episode exactly.

        Returns:
            One rollout of T steps: readings ``(T + 1, sensors)``, actions as applied
            ``(T, actions)``, and rewards ``(T,)`` if the target has its own.

        Raises:
            TargetError: The target cannot go on, or was commanded something that is no number.
            ShapeError: The controller returned the wrong number of commands.
        """

    def limit(self, commands: ArrayLike) -> Array:
        """Returns commands as they are applied, ``(actions,)``.

        Args:
            commands: What a controller returned, ``(actions,)``; a single number will do for one
                action.

        Raises:
            ShapeError: There are more or fewer commands than actions.
            TargetError: A command is not finite, which no limit makes safe.
        """
        values = np.array(commands, dtype=np.float64, ndmin=1)
        if values.shape != (len(self.actions),):
            raise ShapeError(
                f"{self.name} takes {len(self.actions)} commands per step, but the controller "
                f"returned {values.shape=}."
            )
        for column, channel in enumerate(self.actions):
            if not abs(values[column]) < MAX_MAGNITUDE:
                raise TargetError(
                    f"The controller commanded {values[column]} {channel.unit} on {channel.name}."
                )
            values[column] = min(max(values[column], channel.lower), channel.upper)
        return values

    def rollout(
        self,
        readings: ArrayLike,
        actions: ArrayLike,
        rewards: ArrayLike | None = None,
    ) -> Rollouts:
        """Returns what was recorded as one rollout with this target's columns.

        Args:
            readings: Before each step and after the last, ``(T + 1, sensors)``.
            actions: As applied, ``(T, actions)``.
            rewards: ``(T,)``, if the target has its own.
        """
        return Rollouts.from_arrays(
            readings=[np.asarray(readings, dtype=np.float64)],
            actions=[np.asarray(actions, dtype=np.float64)],
            channel_names=[channel.name for channel in self.sensors],
            action_names=[channel.name for channel in self.actions],
            time_step=self.time_step,
            rewards=None if rewards is None else [np.asarray(rewards, dtype=np.float64)],
            channel_units=[channel.unit for channel in self.sensors],
            action_units=[channel.unit for channel in self.actions],
        )

    def __repr__(self) -> str:
        sensors, actions = (
            ", ".join(f"{channel.name} [{channel.unit}]" for channel in channels)
            for channels in (self.sensors, self.actions)
        )
        return f"{self.name}: {sensors}; {actions}; every {self.time_step:g} s"


def end_episode(controller: Controller, readings: ArrayLike) -> None:
    """Hands the last readings of an episode to a controller that keeps a record of it.

    A process killed from then on has the whole episode on disk, and does not repeat it.

    Args:
        controller: What commanded the target; one without a method ``end`` is left alone.
        readings: The readings after the last step, ``(sensors,)``.
    """
    end = getattr(controller, "end", None)
    if end is not None:
        end(np.array(readings, dtype=np.float64))


def partial_rollout(error: BaseException) -> Rollouts | None:
    """Returns what a target recorded before an exception ended its episode.

    It is the exception's attribute ``rollout``, whatever its type, e.g. of a
    ``KeyboardInterrupt``; ``None`` where not even one step was made.
    """
    return getattr(error, "rollout", None)
