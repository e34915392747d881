"""The black-box sample site: a simulator as a statement of a Pyro program."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import pyro
import torch
from pyro.distributions import TorchDistribution
from pyro.poutine.runtime import get_plates
from torch import Tensor
from torch.distributions import constraints

from npdr_ppl.errors import IntractableError, ModelError, ShapeError, SimulationError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.noise import Noise, noise_batch_shape, reading_distribution
from npdr_ppl.language.simulator import Simulator

__all__ = ["BlackBox", "FunctionBlackBox", "SimulatorBlackBox", "SiteLikelihood", "simulate"]

PlainFunction = Callable[..., Tensor]


def simulate(
    name: str,
    simulator: Simulator | PlainFunction,
    parameters: Mapping[str, Tensor],
    inputs: Inputs | None = None,
    *,
    noise: Noise | None = None,
) -> Tensor:
    """Samples a simulator's output: the black-box statement of a model.

    The plates around the statement are the batch, and the whole batch is simulated at once.

    Args:
        name: Name of the sample site.
        simulator: A :class:`~npdr_ppl.language.simulator.Simulator`, or a plain function. A
            function is called with the parameters as keywords, each with one leading batch
            dimension, and returns a tensor ``(batch, ...)``.
        parameters: Domain parameters by name, each of the batch shape (those of a plain function
            may have event dimensions after it).
        inputs: Segments to simulate; a plain function takes none.
        noise: Measurement noise. It is added to samples, and gives the site a density if the
            simulator is deterministic.

    Returns:
        The trajectory, batch shape plus ``(segments, steps, sensors)``, or the function's output.

    Raises:
        ModelError: The simulator has no such parameter, or inputs are missing or superfluous.

    Example:
        >>> import pyro, pyro.distributions as dist, torch
        >>> def model():
        ...     rate = pyro.sample("rate", dist.Uniform(1.0, 2.0))
        ...     return simulate("x", lambda rate: torch.poisson(rate), {"rate": rate})
        >>> model().shape
        torch.Size([])
    """
    black_box: BlackBox
    if isinstance(simulator, Simulator):
        if inputs is None:
            raise ModelError(f"Site {name!r}: {simulator.name} needs inputs; pass the model's.")
        simulator.check_parameters(parameters)
        black_box = SimulatorBlackBox(name, simulator, parameters, inputs, noise)
    else:
        if inputs is not None:
            raise ModelError(
                f"Site {name!r}: a function without inputs was given inputs; declare one that "
                "takes initial states and actions with npdr.FunctionSimulator."
            )
        depth = max((-plate.dim for plate in get_plates() if plate.dim is not None), default=0)
        black_box = FunctionBlackBox(name, simulator, parameters, noise, plate_depth=depth)
    return pyro.sample(name, black_box)


class SiteLikelihood(Protocol):
    """A density for a black-box site, learnt from simulations of it."""

    def log_prob(self, box: "BlackBox", value: Tensor) -> Tensor:
        """Returns the log density of a value, up to a function of the value.

        Args:
            box: The site, with its parameters and inputs.
            value: Batch shape plus event shape.

        Returns:
            Log densities of the batch shape, differentiable in the parameters.
        """
        ...


class BlackBox(TorchDistribution):
    """Distribution of a simulator's output; it can be sampled, but its density may be unknown.

    Attributes:
        site: Name of the sample site.
        parameters: Domain parameters by name.
        noise: Measurement noise, ``None`` if the simulator's output is the observation.
        likelihood: A learnt density that replaces the site's own, ``None`` for none.
    """

    parameters: Mapping[str, Tensor]
    likelihood: SiteLikelihood | None = None

    has_rsample = False
    arg_constraints: dict[str, Any] = {}

    def __init__(self, site: str, noise: Noise | None, batch_shape: torch.Size) -> None:
        self.site = site
        self.noise = noise
        super().__init__(batch_shape, validate_args=False)

    @abstractmethod
    def _run(self, batch_shape: torch.Size) -> Tensor:
        """Simulates once for every element of ``batch_shape``."""

    @property
    @abstractmethod
    def _is_deterministic(self) -> bool:
        """Whether equal parameters give equal output."""

    @property
    @abstractmethod
    def is_differentiable(self) -> bool:
        """Whether the declared noise gives a density with gradients."""

    @property
    def has_density(self) -> bool:
        """Whether the declared noise gives a density."""
        return self.noise is not None and self._is_deterministic

    @property
    def _channel_names(self) -> tuple[str, ...] | None:
        return None

    def _mask(self) -> Tensor | None:
        """Returns a mask over the event, ``None`` if all of the event is valid."""
        return None

    @property
    def support(self) -> constraints.Constraint:
        """Real arrays of the event's shape."""
        return constraints.independent(constraints.real, len(self.event_shape))

    def expand(self, batch_shape: torch.Size, _instance: Any = None) -> "BlackBox":
        """Returns the same site for a larger batch."""
        batch_shape = torch.Size(batch_shape)
        expanded = self.__new__(type(self))
        expanded.__dict__.update(self.__dict__)
        expanded._batch_shape = batch_shape
        return expanded

    def with_noise(self, noise: Noise | None) -> "BlackBox":
        """Returns the same site with another measurement noise, ``None`` for none."""
        changed = self.expand(torch.broadcast_shapes(self.batch_shape, noise_batch_shape(noise)))
        changed.noise = noise
        return changed

    def with_likelihood(self, likelihood: SiteLikelihood | None) -> "BlackBox":
        """Returns the same site with a learnt density, ``None`` for its own."""
        changed = self.expand(self.batch_shape)
        changed.likelihood = likelihood
        return changed

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Simulates the whole batch, and adds the noise if one is declared."""
        with torch.no_grad():
            shape = torch.Size(sample_shape) + self.batch_shape
            output = self._run(shape)
            if self.noise is not None:
                event_dim = output.dim() - len(shape)
                output = reading_distribution(
                    self.noise, output, event_dim, self._channel_names
                ).sample()
                mask = self._mask()
                if mask is not None:
                    output = torch.where(mask, output, torch.zeros_like(output))
            return output

    def log_prob(self, value: Tensor) -> Tensor:
        """Returns the learnt density, or else the density of noisy measurements.

        Raises:
            IntractableError: No density was learnt, and no noise was declared or the simulator is
                itself random.
        """
        if self.likelihood is not None:
            return self.likelihood.log_prob(self, value)
        pointwise, event_dim = self.pointwise_log_prob(value)
        return pointwise.flatten(-event_dim).sum(-1) if event_dim else pointwise

    def pointwise_log_prob(self, value: Tensor) -> tuple[Tensor, int]:
        """Returns the density of every measurement and the number of event dimensions.

        Raises:
            IntractableError: As :meth:`log_prob`.
        """
        if self.noise is None:
            raise IntractableError(
                f"The density of site {self.site!r} is intractable, because its simulator is a "
                "black box that can only be sampled; use a likelihood-free backend "
                "(npdr.infer), declare measurement noise with simulate(..., noise=...), or "
                "give it a learnt density (npdr.with_likelihood)."
            )
        if not self._is_deterministic:
            raise IntractableError(
                f"The density of site {self.site!r} is intractable, because its simulator is "
                "random beyond the declared noise, or starts from an uncertain state; use a "
                "likelihood-free backend (npdr.infer)."
            )
        output = self._run(self.batch_shape)
        event_dim = output.dim() - len(self.batch_shape)
        log_prob = reading_distribution(
            self.noise, output, event_dim, self._channel_names
        ).log_prob(value.to(output.dtype))
        mask = self._mask()
        if mask is not None:
            log_prob = torch.where(mask, log_prob, torch.zeros_like(log_prob))
        return log_prob, event_dim


class SimulatorBlackBox(BlackBox):
    """Distribution of a simulator's trajectory, event shape ``(segments, steps, sensors)``.

    Attributes:
        simulator: The simulator, with its effects.
        parameters: Domain parameters by name.
        inputs: The segments that are simulated.
    """

    def __init__(
        self,
        site: str,
        simulator: Simulator,
        parameters: Mapping[str, Tensor],
        inputs: Inputs,
        noise: Noise | None = None,
    ) -> None:
        self.simulator = simulator
        self.parameters = {name: torch.as_tensor(value) for name, value in parameters.items()}
        self.inputs = inputs
        shapes = [value.shape for value in self.parameters.values()]
        try:
            batch_shape = torch.broadcast_shapes(
                *shapes, inputs.batch_shape, noise_batch_shape(noise)
            )
        except RuntimeError as error:
            described = ", ".join(f"{n}: {tuple(v.shape)}" for n, v in self.parameters.items())
            raise ShapeError(
                f"Site {site!r}: the parameters' shapes do not broadcast ({described}; "
                f"inputs: {tuple(inputs.batch_shape)})."
            ) from error
        super().__init__(site, noise, batch_shape)

    @property
    def event_shape(self) -> torch.Size:
        """``(segments, steps, sensors)``."""
        return torch.Size(
            (self.inputs.num_segments, self.inputs.num_steps, len(self.simulator.sensors))
        )

    @property
    def _is_deterministic(self) -> bool:
        return self.simulator.is_deterministic and not self.inputs.is_start_uncertain

    @property
    def is_differentiable(self) -> bool:
        """Whether the declared noise gives a density with gradients."""
        return self._is_deterministic and self.simulator.is_differentiable

    @property
    def _channel_names(self) -> tuple[str, ...]:
        return tuple(sensor.name for sensor in self.simulator.sensors)

    def _mask(self) -> Tensor | None:
        mask = self.inputs.measured(self._channel_names).to(self.inputs.actions.device)
        return None if bool(mask.all()) else mask

    def with_effects(self, *effects: Any, parameters: Mapping[str, Tensor]) -> "SimulatorBlackBox":
        """Returns the site with effects attached and their parameters added."""
        changed = SimulatorBlackBox(
            self.site,
            self.simulator.with_effects(*effects),
            {**self.parameters, **parameters},
            self.inputs,
            self.noise,
        )
        changed.likelihood = self.likelihood
        return changed

    def with_simulator(self, simulator: Simulator) -> "SimulatorBlackBox":
        """Returns the same site with another simulator that has the same channels."""
        changed = self.expand(self.batch_shape)
        changed.simulator = simulator
        return changed

    def _run(self, batch_shape: torch.Size) -> Tensor:
        device = self.inputs.actions.device
        parameters = {name: value.to(device) for name, value in self.parameters.items()}
        if not self.simulator.is_deterministic:
            # Every element of the batch needs independent random numbers.
            parameters = {name: value.expand(batch_shape) for name, value in parameters.items()}
        inputs = self.inputs.with_drawn_start(batch_shape)
        output = self.simulator.simulate(parameters, inputs)
        if output.is_complex():
            raise SimulationError(f"{self.simulator.name} returned complex numbers.")
        if output.shape[-3:] != self.event_shape:
            raise SimulationError(
                f"{self.simulator.name} returned a trajectory of shape {tuple(output.shape)}; "
                f"expected (..., {', '.join(map(str, self.event_shape))})."
            )
        output = inputs.at_measured_times(output, self._channel_names)
        return output.expand(batch_shape + self.event_shape)


class FunctionBlackBox(BlackBox):
    """Distribution of a plain function's output; the event shape is known after the first call."""

    def __init__(
        self,
        site: str,
        function: PlainFunction,
        parameters: Mapping[str, Tensor],
        noise: Noise | None = None,
        *,
        plate_depth: int = 0,
    ) -> None:
        self.function = function
        self.parameters = {name: torch.as_tensor(value) for name, value in parameters.items()}
        # A parameter's leading dimensions are the plates around the statement; the other
        # dimensions are the parameter's own shape.
        self._event_dims = {
            name: max(0, value.dim() - plate_depth) for name, value in self.parameters.items()
        }
        leading = [
            value.shape[: value.dim() - self._event_dims[name]]
            for name, value in self.parameters.items()
        ]
        self._known_event_shape: torch.Size | None = None
        super().__init__(site, noise, torch.broadcast_shapes(*leading, noise_batch_shape(noise)))

    @property
    def event_shape(self) -> torch.Size:
        """Shape of one output; the function is called once to find out."""
        if self._known_event_shape is None:
            with torch.no_grad(), torch.random.fork_rng(devices=[]):
                self._run(torch.Size())
        assert self._known_event_shape is not None
        return self._known_event_shape

    @property
    def is_differentiable(self) -> bool:
        """Whether the declared noise gives a density with gradients, found by one test call."""
        arguments = {
            name: value.detach().double().requires_grad_()
            for name, value in self.parameters.items()
        }
        probe = FunctionBlackBox(self.site, self.function, arguments, self.noise)
        probe._event_dims = self._event_dims
        try:
            with torch.random.fork_rng(devices=[]), torch.enable_grad():
                return bool(probe._run(self.batch_shape).requires_grad)
        except RuntimeError:  # e.g. NumPy does not accept tensors with gradients
            return False

    @property
    def _is_deterministic(self) -> bool:
        # With declared noise, the function is assumed to be noise-free.
        return self.noise is not None

    def _run(self, batch_shape: torch.Size) -> Tensor:
        num_simulations = batch_shape.numel()
        arguments = {}
        for name, value in self.parameters.items():
            split = value.dim() - self._event_dims[name]
            event = value.shape[split:]
            if batch_shape == torch.Size() and split:
                value = value.reshape((-1, *event))[0]
            arguments[name] = value.expand(batch_shape + event).reshape((num_simulations, *event))
        output = self.function(**arguments)
        if not isinstance(output, Tensor) or output.shape[:1] != (num_simulations,):
            came = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
            raise SimulationError(
                f"The function behind site {self.site!r} should return a tensor whose first "
                f"dimension is the batch ({num_simulations}), got {came}."
            )
        if output.is_complex():
            raise SimulationError(
                f"The function behind site {self.site!r} returned complex numbers."
            )
        self._known_event_shape = output.shape[1:]
        return output.reshape(batch_shape + output.shape[1:])
