"""Any Gymnasium environment as a simulator."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.gymnasium.attributes import Attribute, Path, vector
from npdr_ppl.engines.gymnasium.environments import (
    box_channels,
    limited_channels,
    load_gymnasium,
    make_environment,
)
from npdr_ppl.engines.pooled.pool_simulator import Segment
from npdr_ppl.engines.pooled.stepped_simulator import SteppedSimulator
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs

__all__ = ["GymnasiumSimulator"]

Array = NDArray[np.float64]

# Environments that are not written in Python often accept only 32-bit seeds.
_SEEDS = 2**31

# Time steps with a smaller relative difference count as equal: time stamps are rounded.
_SAME_STEP = 1e-6


_TAKES = {
    "set_parameters": "the values of parameters by name",
    "set_state": "a state",
    "read": "an observation",
    "act": "commands",
}
"""The second argument of each function that a user gives."""


class GymnasiumSimulator(SteppedSimulator):
    """An environment whose parameters and initial state are set, simulated on workers.

    Functions receive the environment without its wrappers and are sent to workers. In every
    simulation, first the parameters are set, then the environment is reset, then its state is set.
    If an environment terminates or truncates an episode, the simulation continues as far as the
    environment allows.

    Action and sensor channels are ports. Effects cannot act on forces inside the environment.

    Args:
        environment: Id of a registered environment, or a function that makes one.
        parameters: Domain parameters by name: an :class:`Attribute` of the environment, whose
            present value is the nominal one; or a declaration, for ``set_parameters``.
        set_parameters: Called with the environment and all parameters by name after attributes
            have been set; use it for values that depend on several parameters or need a method.
        states: Components of the state, in the order in which they are set.
        set_state: Called with the environment and a state ``(states,)``; or the path of the
            attribute that contains the state, e.g. ``"state"``.
        sensors: Channels that are measured after each step. ``None`` for the states, or, if there
            are no states, the entries of the observation, ``observation_0`` and so on.
        read: Maps the environment and an observation to the measurements ``(sensors,)``; or the
            path of an attribute. ``None`` uses the attribute of the state if ``set_state`` is a
            path and no sensors are given, and the observation otherwise. Before the first step,
            the observation is that of the reset and does not show the state that was set.
        actions: Names and units of the commands; ``None`` for ``action_0`` and so on. If the
            action space is a box, the commands have its limits.
        act: Maps the environment and commands ``(actions,)`` to an action of the environment;
            needed if the action space is not a box.
        rated: Typical magnitudes by channel, with which effects scale their priors. The default
            for an action is its limit.
        time_step: Seconds per step; ``None`` for the environment's attribute ``dt``.
        is_deterministic: Whether the steps use no random numbers.

    Raises:
        DependencyError: Gymnasium is not installed.
        ModelError: The environment does not exist, or an argument does not fit it.

    Example:
        >>> GymnasiumSimulator(
        ...     "Pendulum-v1",
        ...     parameters={"mass": Attribute("m", "kg"), "length": Attribute("l", "m")},
        ...     states=(Channel("angle", "rad"), Channel("velocity", "rad/s", rate_of="angle")),
        ...     set_state="state",
        ...     actions=(Channel("torque", "N m"),),
        ... ).parameters[0]
        Parameter(name='mass', unit='kg', nominal=1.0, description='m')
    """

    def __init__(
        self,
        environment: str | Callable[[], Any],
        *,
        parameters: Mapping[str, Attribute | Parameter] | None = None,
        set_parameters: Callable[[Any, Mapping[str, float]], None] | None = None,
        states: Sequence[Channel] = (),
        set_state: str | Callable[[Any, Array], None] | None = None,
        sensors: Sequence[Channel] | None = None,
        read: str | Callable[[Any, Any], Any] | None = None,
        actions: Sequence[Channel] | None = None,
        act: Callable[[Any, Array], Any] | None = None,
        rated: Mapping[str, float] | None = None,
        time_step: float | None = None,
        is_deterministic: bool = True,
    ) -> None:
        if not (isinstance(environment, str) or callable(environment)):
            raise ModelError(
                "Workers make their environments themselves: give an id or a function that makes "
                f"one, not {environment!r}."
            )
        functions = {
            "set_parameters": set_parameters,
            "set_state": set_state,
            "read": read,
            "act": act,
        }
        for name, function in functions.items():
            _check_function(name, function)
        self._make = environment
        self.is_deterministic = is_deterministic
        self.states = tuple(states)
        self._set_parameters, self._act = set_parameters, act
        if states and set_state is None:
            raise ModelError("States are put into the environment: give set_state.")
        self._set_state = Path(set_state).set if isinstance(set_state, str) else set_state
        if read is None and sensors is None and isinstance(set_state, str):
            read = set_state
        self._read = read
        # An environment of the user is registered where its file was imported, not on workers.
        self._specification: Any = None
        made = self.set_up()
        if isinstance(environment, str):
            self._specification = made.spec
        try:
            made.reset(seed=0)  # some attributes exist only after a reset
            self._declare(made, parameters or {}, sensors, actions, time_step)
            self.ports = self._find_ports(rated or {})
            self._try_out(made)
        finally:
            made.close()

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"GymnasiumSimulator({self._label})"

    @property
    def _label(self) -> str:
        make = self._make
        return make if isinstance(make, str) else getattr(make, "__qualname__", repr(make))

    def recorded_settings(self) -> dict[str, Any]:
        """Returns the environment's name and the engine's version."""
        version = load_gymnasium().__version__
        return {
            "engine": "gymnasium",
            "version": version,
            "environment": self._label,
            "time_step": self.time_step,
        }

    def check_inputs(self, inputs: Inputs) -> None:
        """Raises a DataError if the inputs' channels or time step do not fit."""
        super().check_inputs(inputs)
        self._check_step(inputs.time_step, DataError)

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`SteppedSimulator.run_episodes`."""
        self._check_step(request.time_step, ModelError)
        return super().run_episodes(request)

    def set_up(self) -> Any:
        """Makes an environment."""
        # Steps after the end of an episode are intended here, so no warning is needed.
        load_gymnasium().logger.min_level = load_gymnasium().logger.ERROR
        if isinstance(self._make, str):
            return make_environment(self._make, self._specification, is_checked=False)
        return self._make()

    def begin(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> "_Simulation":
        """Begins a simulation; see :meth:`SteppedSimulator.begin`."""
        inner = workspace.unwrapped
        for name, path in self._paths:
            path.set(inner, parameters[name])
        if self._set_parameters is not None:
            own = {parameter.name: parameters[parameter.name] for parameter in self.parameters}
            self._set_parameters(inner, own)
        observation, _ = workspace.reset(seed=seed % _SEEDS)
        if self._set_state is not None:
            self._set_state(inner, np.array(segment.initial_state))
        return _Simulation(workspace, self._act, self._read, segment, observation)

    def _declare(
        self,
        environment: Any,
        parameters: Mapping[str, Attribute | Parameter],
        sensors: Sequence[Channel] | None,
        actions: Sequence[Channel] | None,
        time_step: float | None,
    ) -> None:
        """Sets parameters, channels and time step."""
        inner, box = environment.unwrapped, load_gymnasium().spaces.Box
        for name, given in parameters.items():
            if isinstance(given, Parameter) and given.name != name:
                raise ModelError(f"The parameter {given.name!r} is given as {name!r}.")
        self.parameters = tuple(
            given.parameter(name, inner) if isinstance(given, Attribute) else given
            for name, given in parameters.items()
        )
        self._paths = tuple(
            (name, Path(given.path))
            for name, given in parameters.items()
            if isinstance(given, Attribute)
        )
        if len(self._paths) < len(parameters) and self._set_parameters is None:
            raise ModelError("Parameters that are no attributes need a set_parameters.")
        if isinstance(environment.action_space, box) and self._act is None:
            self.actions = limited_channels(environment.action_space, actions, self.name)
        elif self._act is None or actions is None:
            raise ModelError(
                f"{self.name} takes actions from {environment.action_space}: name the actions, "
                "and give an act that makes such an action of real numbers."
            )
        else:
            self.actions = tuple(actions)
        if sensors is None and not self.states:
            if not isinstance(environment.observation_space, box):
                raise ModelError(
                    f"{self.name} needs sensors and a function to read them, because its "
                    f"observations are {environment.observation_space}, no Box."
                )
            sensors = box_channels(environment.observation_space, "observation")
        self.sensors = self.states if sensors is None else tuple(sensors)
        if time_step is None:
            time_step = getattr(inner, "dt", None)
        if time_step is None:
            raise ModelError(f"{self.name} does not say how long a step is: give time_step.")
        self.time_step = float(time_step)

    def _find_ports(self, rated: Mapping[str, float]) -> tuple[Port, ...]:
        """Returns a port for each channel."""
        sizes = {a.name: a.upper for a in self.actions if np.isfinite(a.upper) and a.upper > 0}
        sizes |= rated
        kinds = [("action", channel) for channel in self.actions]
        kinds += [("sensor", channel) for channel in self.sensors]
        names = [channel.name for _, channel in kinds]
        unknown = sorted(set(rated) - set(names))
        twice = sorted({name for name in names if names.count(name) > 1})
        if unknown or twice:
            raise ModelError(
                f"{', '.join(unknown or twice)} names {'two channels' if twice else 'no channel'} "
                f"of {self.name}."
            )
        return tuple(
            Port(channel.name, "action" if kind == "action" else "sensor", channel.unit,
                 sizes.get(channel.name, 1.0))
            for kind, channel in kinds
        )  # fmt: skip

    def _try_out(self, environment: Any) -> None:
        """Begins a simulation in the state after a reset, to find mistakes at construction."""
        inner = environment.unwrapped
        nominal = {parameter.name: parameter.nominal for parameter in self.parameters}
        start = np.zeros(len(self.states))
        segment = Segment(start, np.zeros((1, len(self.actions))), self.time_step, 0.0)
        found = np.shape(self.begin(environment, nominal, segment, 0).read())
        if found != (len(self.sensors),):
            raise ModelError(
                f"{self.name} has {len(self.sensors)} sensors, but reading {inner} gave an array "
                f"of shape {found}: give read, or sensors that name what is read."
            )

    def _check_step(self, time_step: float, error: type[DataError] | type[ModelError]) -> None:
        if abs(time_step - self.time_step) > _SAME_STEP * self.time_step:
            raise error(
                f"{self.name} makes steps of {self.time_step:g} s, but {time_step:g} s were asked "
                "for; resample the data, or make an environment with that step."
            )


def _check_function(name: str, function: object) -> None:
    """Raises a ModelError if an argument is a function that cannot be called as it will be."""
    if not callable(function):
        return
    try:
        inspect.signature(function).bind(None, None)
    except ValueError:  # it has no signature
        return
    except TypeError as error:
        own = inspect.signature(function)
        raise ModelError(
            f"{name} is called with the environment and {_TAKES[name]}; yours takes {own}."
        ) from error


class _Simulation:
    """A running episode of an environment, which workers advance step by step."""

    def __init__(
        self,
        environment: Any,
        act: Callable[[Any, Array], Any] | None,
        read: str | Callable[[Any, Any], Any] | None,
        segment: Segment,
        observation: Any,
    ) -> None:
        self._inner = environment.unwrapped
        self._step, self._segment = environment.step, segment
        self._observation = observation
        self._space = environment.action_space
        self._act = self._boxed if act is None else act
        self._reading: Callable[[Any, Any], Any]
        if isinstance(read, str):
            get = Path(read).getter()
            self._reading = lambda inner, _: get(inner)
        else:
            self._reading = _observed if read is None else read

    def read(self) -> Array:
        """Returns the present measurements."""
        return vector(self._reading(self._inner, self._observation))

    def advance(self, step: int) -> None:
        """Makes a step."""
        action = self._act(self._inner, self._segment.actions[step])
        self._observation = self._step(action)[0]

    def _boxed(self, inner: Any, commands: Array) -> Array:
        action = commands.astype(self._space.dtype)
        return action if len(self._space.shape) == 1 else action.reshape(self._space.shape)


def _observed(inner: Any, observation: Any) -> Any:
    return observation
