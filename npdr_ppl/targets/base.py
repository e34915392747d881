"""Base class of target domains: a target runs a controller and returns the recording."""

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
"""Function from measurements ``(sensors,)``, in the order of the target's sensors, and the time
since the episode's start in s to commands ``(actions,)``, before any limit is applied."""


class TargetError(NpdrError, RuntimeError):
    """A target domain cannot continue, and a person should check it."""


class TargetDomain(ABC):
    """The real device of the policy loop: a rig, another engine, or recorded data.

    A target does not use our models, posteriors or rewards. Its users see only its channels and
    its recordings; any parameters are private.

    Attributes:
        name: Name in tables and files.
        sensors: Measured channels, with units and the bounds of safe operation.
        actions: Command channels, with the limits that the target applies.
        time_step: Seconds between commands.
        is_recorded: Whether episodes were recorded in advance, so that controllers are ignored.
        num_episodes: Number of available episodes; ``None`` if it is unlimited.
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

        A controller may have memory and is therefore used for one episode only. Slow actions after
        the last measurement (homing, disconnecting) follow the call of :func:`end_episode`. If an
        exception ends the episode, it carries the recording up to then; see
        :func:`partial_rollout`.

        Args:
            controller: Function that commands the target.
            num_steps: Maximum number of steps; an episode that leaves the bounds is shorter.
            episode: Number of the episode in the caller's run, from 0; selects among recordings.
            seed: Random seed: with the same seed, a simulated target repeats an episode exactly.

        Returns:
            One rollout of T steps: measurements ``(T + 1, sensors)``, actions as applied
            ``(T, actions)``, and rewards ``(T,)`` if the target has its own.

        Raises:
            TargetError: The target cannot continue, or a command is not a finite number.
            ShapeError: The controller returned the wrong number of commands.
        """

    def limit(self, commands: ArrayLike) -> Array:
        """Returns commands as they are applied, ``(actions,)``.

        Args:
            commands: Output of a controller, ``(actions,)``; may be a single number if there is
                one action.

        Raises:
            ShapeError: There are more or fewer commands than actions.
            TargetError: A command is not finite; no limit can make it safe.
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
        """Returns a recording as one rollout with this target's columns.

        Args:
            readings: Measurements before each step and after the last, ``(T + 1, sensors)``.
            actions: Commands as applied, ``(T, actions)``.
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
    """Gives the last measurements of an episode to a controller that records the episode.

    The whole episode is then on disk, so that a run that is killed later does not repeat it.

    Args:
        controller: Controller of the episode; nothing happens if it has no method ``end``.
        readings: The measurements after the last step, ``(sensors,)``.
    """
    end = getattr(controller, "end", None)
    if end is not None:
        end(np.array(readings, dtype=np.float64))


def partial_rollout(error: BaseException) -> Rollouts | None:
    """Returns the recording of a target up to the exception that ended its episode.

    It is the attribute ``rollout`` of the exception, which can have any type, e.g.
    ``KeyboardInterrupt``. The result is ``None`` if no step was completed.
    """
    return getattr(error, "rollout", None)
