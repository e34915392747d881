"""Any Gymnasium environment with a box of actions as a target domain."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from npdr_ppl.engines.gymnasium.environments import (
    box_channels,
    limited_channels,
    load_gymnasium,
    make_environment,
)
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import Array, Controller, TargetDomain, end_episode

__all__ = ["GymnasiumTarget"]


class GymnasiumTarget(TargetDomain):
    """Runs controllers in a Gymnasium environment and records its observations and rewards.

    An episode ends when the environment terminates or truncates it. Note the step limits that
    ``gymnasium.make`` adds.

    Args:
        environment: An environment, or the id of a registered one, e.g. ``"Pendulum-v1"``.
        sensors: Names, units and bounds of the measurements; ``None`` names the observation's
            entries ``observation_0`` and so on, with the bounds of its box.
        actions: Names and units of the commands; ``None`` names them ``action_0`` and so on.
            The limits always come from the environment's box.
        read: Function from an observation to measurements ``(sensors,)``, e.g. from a cosine and a
            sine to an angle; needs ``sensors``. ``None`` uses the observation unchanged.
        time_step: Seconds per step; ``None`` uses the environment's attribute ``dt``.
        name: Name in tables and files; ``None`` uses the environment's id.

    Raises:
        DependencyError: Gymnasium is not installed.
        ModelError: The environment does not exist, or its spaces or time step are unsuitable.

    Example:
        >>> pendulum = GymnasiumTarget(
        ...     "Pendulum-v1",
        ...     sensors=(Channel("angle", "rad"), Channel("velocity", "rad/s")),
        ...     actions=(Channel("torque", "N m"),),
        ...     read=lambda o: np.array([np.arctan2(o[1], o[0]), o[2]]),
        ... )
        >>> pendulum
        Pendulum-v1: angle [rad], velocity [rad/s]; torque [N m]; every 0.05 s
    """

    def __init__(
        self,
        environment: Any,
        *,
        sensors: Sequence[Channel] | None = None,
        actions: Sequence[Channel] | None = None,
        read: Callable[[Any], Array] | None = None,
        time_step: float | None = None,
        name: str | None = None,
    ) -> None:
        gymnasium = load_gymnasium()
        if isinstance(environment, str):
            environment = make_environment(environment)
        self._environment = environment
        self._read = read or _flat
        spec = environment.spec
        self.name = name or (spec.id if spec else type(environment.unwrapped).__name__)
        is_box = isinstance(environment.observation_space, gymnasium.spaces.Box)
        if sensors is None and read is not None:
            raise ModelError(f"{self.name} needs sensors, because it has a function to read them.")
        if read is None and not is_box:
            raise ModelError(
                f"{self.name} needs sensors and a function to read them, because its observations "
                f"are {environment.observation_space}, no Box."
            )
        if not isinstance(environment.action_space, gymnasium.spaces.Box):
            raise ModelError(
                f"{self.name} takes actions from {environment.action_space}, but controllers "
                "command real numbers, of a Box."
            )
        self.sensors = (
            box_channels(environment.observation_space, "observation")
            if sensors is None
            else tuple(sensors)
        )
        self.actions = limited_channels(environment.action_space, actions, self.name)
        if time_step is None:
            time_step = getattr(environment.unwrapped, "dt", None)
        if time_step is None:
            raise ModelError(f"{self.name} does not say how long a step is: give time_step.")
        self.time_step = float(time_step)

    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Runs one episode from the environment's own initial state; see :class:`TargetDomain`.

        The rollout's rewards are the environment's.
        """
        environment, space = self._environment, self._environment.action_space
        # Environments that are not written in Python accept only 32-bit seeds.
        observation, _ = environment.reset(seed=derived_seed(seed, "environment") % 2**31)
        readings = [self._reading(observation)]
        actions: list[Array] = []
        rewards: list[float] = []
        for step in range(num_steps):
            commands = self.limit(controller(readings[-1].copy(), step * self.time_step))
            applied = commands.astype(space.dtype).reshape(space.shape)
            observation, reward, is_terminated, is_truncated, _ = environment.step(applied)
            readings.append(self._reading(observation))
            actions.append(_flat(applied))
            rewards.append(float(reward))
            if is_terminated or is_truncated:
                break
        end_episode(controller, readings[-1])
        return self.rollout(readings, actions, rewards)

    def close(self) -> None:
        """Closes the environment."""
        self._environment.close()

    def _reading(self, observation: Any) -> Array:
        """Returns a copy of an observation's measurements: environments may reuse arrays."""
        reading = np.array(self._read(observation), dtype=np.float64)
        if reading.shape != (len(self.sensors),):
            raise ModelError(
                f"{self.name} has {len(self.sensors)} sensors, but an observation gave "
                f"{reading.shape=}."
            )
        return reading


def _flat(values: Any) -> Array:
    return np.array(values, dtype=np.float64).reshape(-1)
