"""A recording's segments, simulated by a model with one black-box site.

The recording is cut into segments. Each starts from a state that is only known within the
smoother's error. A simulation therefore depends on the parameters, which all segments share, and
on the offset of each segment's own initial state.
"""

import copy
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.commands_before import began_in_operation
from npdr_ppl.preparation.data_options import MAX_READINGS_PER_CHUNK, DataOptions
from npdr_ppl.preparation.effective_share import effective_share
from npdr_ppl.preparation.initial_states import (
    InitialStates,
    uncertain_components,
    with_spins,
)
from npdr_ppl.preparation.settings import LINEARISATION
from npdr_ppl.rollouts import Rollouts

__all__ = ["SimulatedSegments"]


class SimulatedSegments:
    """A model with one black-box site, simulated along a recording from shifted initial states.

    Args:
        model: The Pyro model.
        rollouts: The recording.
        options: Segments, initial states and precision; where initial states are ``"uncertain"``
            they can be shifted, otherwise m is zero.
        starts: Initial states of the segments, if known better than by the smoother.
        is_complete: Whether all segments are simulated, also those of a very long recording, to
            compare the whole recording; see :meth:`DataOptions.num_segments`.

    Attributes:
        model: The model.
        rollouts: The recording.
        prior: The model's prior.
        inputs: The segments.
        sensor_names: The channels that the simulator reports.
        measured: The C of them that were measured, as the simulator declares them.
        channel_names: Their names.
        observed: The measurements, ``(S, K, C)``.
        starts: Initial states of the segments, if they were given.
        steps_per_average: Steps whose whitened residuals are averaged; see :meth:`averaged`.
    """

    steps_per_average = 1
    channel_names: tuple[str, ...] = ()

    def __init__(
        self,
        model: Model,
        rollouts: Rollouts,
        options: DataOptions,
        starts: InitialStates | None = None,
        *,
        is_complete: bool = False,
    ) -> None:
        self.rollouts = rollouts
        self._cut = (options.every_segment if is_complete else options.inputs)(rollouts)
        self._trace(model)
        self._start_from(starts)
        self._has_guessed_commands = (
            options.commands_before == "auto" and options.initial_state == "uncertain"
        )
        here = torch.zeros(1, self.prior.num_parameters, dtype=torch.float64)
        if self._has_guessed_commands and began_in_operation(self.black_box(here), self.inputs):
            self._set_began_in_operation(True)

    def with_other_commands_before(self) -> Self | None:
        """Returns the model along a recording that began in operation if this one did not.

        Or the other way round. ``None`` if the options say what was before, or if this is already
        the other way round than was guessed at first.
        """
        if not self._has_guessed_commands:
            return None
        other = copy.copy(self)
        other._has_guessed_commands = False
        other._set_began_in_operation(not self._cut.began_in_operation)
        return other

    def _set_began_in_operation(self, began: bool) -> None:
        self._cut, self._smoothed = (
            replace(inputs, began_in_operation=began) for inputs in (self._cut, self._smoothed)
        )
        self._start_from(self.starts)

    def with_model(self, model: Model) -> Self:
        """Returns another model along the same segments, with the same initial states.

        The recording is neither cut nor smoothed again, and both share its measurements.

        Args:
            model: The other Pyro model.

        Raises:
            DataError: The recording does not fit the model.
        """
        other = copy.copy(self)
        other._trace(model)
        other._start_from(self.starts)
        return other

    def starting_from(self, starts: InitialStates | None) -> Self:
        """Returns the model with other initial states of the segments.

        Args:
            starts: The initial states; ``None`` for those of the smoother.
        """
        other = copy.copy(self)
        other._start_from(starts)
        return other

    @property
    def recorded_rates(self) -> Tensor | None:
        """The smoother's rates of the channels at the segments' starts, ``(S, C)``.

        ``None`` if they are not estimated. :meth:`starting_from` does not change them.
        """
        return self._cut.initial_rates

    def along(self, index: Tensor) -> Self:
        """Returns the model along some of the segments.

        Args:
            index: Their indices.
        """
        part = copy.copy(self)
        part.__dict__.pop("least_scale", None)
        part.__dict__.pop("num_measured", None)
        part.observed = self.observed[index]
        part._cut = self._cut.segments(index)
        part._smoothed = self._smoothed.segments(index)
        part._start_from(None if self.starts is None else self.starts.segments(index))
        return part

    def averaged(self, most: int, fewest: int) -> Self:
        """Returns the model with averages of residuals, if a recording has very many.

        Each average of w steps is multiplied by √w. White noise then keeps unit variance, and slow
        changes stay as detectable as before. Changes that are faster than the average are lost.

        Args:
            most: Number of residuals that need no averaging. More are left if segments are short.
            fewest: Least number of averages in a segment; a segment of fewer than twice as many
                steps is not averaged.
        """
        readings = int(self.is_measured.expand(self.observed.shape).sum())
        part = copy.copy(self)
        part.steps_per_average = min(-(-readings // most), self.inputs.num_steps // fewest)
        return part if part.steps_per_average > 1 else self

    def _trace(self, model: Model) -> None:
        """Runs the model once, to find its priors, its simulator and the measured channels."""
        self.model = model
        self.prior = Prior(with_noise(model, None), (self._cut,))
        boxes = self.prior.black_boxes
        if len(boxes) != 1:
            raise DataError(f"The model has {len(boxes)} black-box sites; expected one.")
        self._site, box = next(iter(boxes.items()))
        if not isinstance(box, SimulatorBlackBox):
            raise DataError(f"Site {self._site!r} is a plain function and has no trajectory.")
        rollouts, sensors = self.rollouts, box.simulator.sensors
        self.sensor_names = names = tuple(sensor.name for sensor in sensors)
        self.measured = tuple(s for s in sensors if s.name in rollouts.measured_names)
        if not self.measured:
            raise DataError(
                f"None of the recording's columns {', '.join(rollouts.channel_names)} is a sensor "
                f"of the model, {', '.join(names)}; rename them."
            )
        before, self.channel_names = self.channel_names, tuple(s.name for s in self.measured)
        self._columns = [names.index(name) for name in self.channel_names]
        if self.channel_names != before:
            self.observed = rollouts.observation(self._cut, channels=self.channel_names)
            self.__dict__.pop("least_scale", None)
            self.__dict__.pop("num_measured", None)
        smoothed = _with_lagging_rates(self._cut, rollouts, box.simulator.rate_lag)
        states = InitialStates.of(smoothed)
        if states is not None:
            smoothed = with_spins(states, box.simulator, rollouts).put_into(smoothed)
        self._smoothed = smoothed

    def _start_from(self, starts: InitialStates | None) -> None:
        self.starts = starts
        self.inputs = self._smoothed if starts is None else starts.put_into(self._smoothed)
        self._offsets = uncertain_components(self.inputs)

    @cached_property
    def least_scale(self) -> Tensor:
        """Least scale of each channel's residuals, in its unit, ``(C,)``."""
        largest = (self.observed * self.is_measured).abs().amax((0, 1)).double()
        return (LINEARISATION.relative_scale_floor * largest).clamp_min(
            LINEARISATION.absolute_scale_floor
        )

    @property
    def is_measured(self) -> Tensor:
        """Whether there is a measurement, ``(S, K, C)``, or ``(S, K, 1)`` for all channels."""
        return self.inputs.measured(self.channel_names)

    @cached_property
    def num_measured(self) -> Tensor:
        """Number of measurements of each channel in each segment, ``(S, C)``."""
        return self.is_measured.expand(self.observed.shape).sum(1)

    @property
    def num_offsets(self) -> int:
        """Number m of components of an initial state that are uncertain."""
        return len(self._offsets)

    @property
    def no_offsets(self) -> Tensor:
        """Offsets that leave every initial state at its estimate, ``(S, m)``."""
        shape = self.inputs.num_segments, self.num_offsets
        return torch.zeros(shape, dtype=torch.float64)

    @property
    def draws_per_chunk(self) -> int:
        """Number of simulations of the whole recording that are made at once, to bound memory."""
        return max(1, MAX_READINGS_PER_CHUNK // max(1, self.observed.numel()))

    def simulate(self, z: Tensor, offsets: Tensor) -> Tensor:
        """Returns readings after each step, ``(n, S, K, C)``.

        Args:
            z: Parameters, ``(n, d)``.
            offsets: Offsets of the initial states, ``(n, S, m)``.
        """
        box = self.black_box(z)
        return self.run(box.simulator, box.parameters, offsets)

    @property
    def simulator(self) -> Simulator:
        """The model's simulator, effects included."""
        box = self.prior.black_boxes[self._site]
        assert isinstance(box, SimulatorBlackBox)
        return box.simulator

    @property
    def coordinates_with_minima(self) -> Tensor:
        """Mask ``(d,)`` of the coordinates along which the misfit has local minima."""
        masked = torch.zeros(self.prior.num_parameters, dtype=torch.bool)
        names = {
            name
            for effect in self.simulator.effects
            if effect.has_local_minima
            for name in effect.parameter_names
        }
        for site in self.prior.sites:
            if site.name in names:
                masked[site.coordinates] = True
        return masked

    def place_of(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns reference coordinates from which a fit may begin, ``(d,)``.

        Args:
            parameters: Parameters by latent site; the others are in the middle of their priors.
        """
        z = torch.zeros(self.prior.num_parameters, dtype=torch.float64)
        if not parameters:
            return z
        middle = self.prior.to_parameters(z[None])
        known = {name: torch.as_tensor(value)[None] for name, value in parameters.items()}
        z = self.prior.to_reference({name: known.get(name, v) for name, v in middle.items()})
        return z[0].nan_to_num(0.0).clamp(-LINEARISATION.start_limit, LINEARISATION.start_limit)

    def black_box(self, z: Tensor) -> SimulatorBlackBox:
        """Returns the black-box site of the model at n points, ``(n, d)``."""
        box = self.prior.black_boxes_at(z)[self._site]
        assert isinstance(box, SimulatorBlackBox)
        return box

    def run(
        self, simulator: Simulator, parameters: Mapping[str, Tensor], offsets: Tensor
    ) -> Tensor:
        """Returns readings of a simulator along the recording, ``(n, S, K, C)``.

        Args:
            simulator: The model's own, or one with further effects.
            parameters: Parameters by name, ``(n,)`` each, or fewer that broadcast to n.
            offsets: Offsets of the initial states, ``(n, S, m)``.
        """
        simulated = simulator.simulate(parameters, self._shifted(offsets))[..., self._columns]
        simulated = self.inputs.at_measured_times(simulated, self.channel_names)
        num = torch.broadcast_shapes(simulated.shape[:-3], offsets.shape[:1])
        return simulated.expand(*num, *self.observed.shape)

    def difference(self, z: Tensor, offsets: Tensor) -> Tensor:
        """Returns measurement minus simulation, ``(n, S, K, C)``; see :meth:`simulate`."""
        return self.observed - self.simulate(z, offsets)

    def residuals(self, z: Tensor, offsets: Tensor, scale: Tensor) -> Tensor:
        """Returns whitened residuals, ``(n, S, N)`` float64, zero where nothing was measured.

        N is K · C, or ⌈K / w⌉ · C where w steps are averaged.

        Args:
            z: Parameters, ``(n, d)``.
            offsets: Offsets of the initial states, ``(n, S, m)``.
            scale: Standard deviation of each channel's residuals, ``(C,)``.
        """
        num, together = max(len(z), len(offsets)), self.draws_per_chunk
        z, offsets = (part.expand(num, *part.shape[1:]) for part in (z, offsets))
        if num <= together:
            return self.whitened(self.difference(z, offsets), scale)
        parts = zip(z.split(together), offsets.split(together), strict=True)
        return torch.cat([self.residuals(*part, scale) for part in parts])

    def whitened(self, difference: Tensor, scale: Tensor) -> Tensor:
        """Returns a difference of readings ``(…, S, K, C)`` in scales, as :meth:`residuals`."""
        # One product: of a long recording every copy takes a hundred megabytes.
        whitened = difference.double() * (self.is_measured / scale)
        width = self.steps_per_average
        if width > 1:
            missing = -self.inputs.num_steps % width
            steps = pad(whitened, (0, 0, 0, missing)).unflatten(-2, (-1, width))
            counts = pad(self.is_measured.double(), (0, 0, 0, missing)).unflatten(-2, (-1, width))
            whitened = steps.sum(-2) / counts.sum(-2).clamp_min(1.0).sqrt()
        return whitened.flatten(-2)

    def effective_share(self, residual: Tensor) -> float:
        """Returns the effective number of independent measurements as a share of all.

        Args:
            residual: Whitened residuals, ``(S, N)``, none of them averaged.
        """
        assert self.steps_per_average == 1
        by_step = residual.unflatten(-1, (-1, len(self.channel_names)))
        return float(effective_share(by_step, self.is_measured).mean())

    def root_mean_square(self, difference: Tensor) -> Tensor:
        """Returns the size of a difference of readings ``(S, K, C)`` per channel, ``(C,)``."""
        square = difference.double().square() * self.is_measured
        return (square.sum((0, 1)) / self.num_measured.sum(0).clamp_min(1)).sqrt()

    def scale_of(self, z: Tensor, offsets: Tensor) -> Tensor:
        """Returns the root-mean-square residual per channel, ``(C,)``, at ``(d,)``, ``(S, m)``."""
        residual = self.observed - self.simulate(z[None], offsets[None])[0]
        return self.root_mean_square(residual).maximum(self.least_scale)

    def _shifted(self, offsets: Tensor) -> Inputs:
        """Returns the inputs with their initial states shifted, a batch of n."""
        changed = {
            "initial_values": self.inputs.initial_values,
            "initial_rates": self.inputs.initial_rates,
        }
        for k, (name, column, error) in enumerate(self._offsets):
            value = changed[name]
            assert value is not None
            shift = torch.zeros_like(value)
            shift[..., column] = 1.0
            changed[name] = value + shift * (offsets[..., k] * error).to(value)[..., None]
        return replace(self.inputs, **changed, initial_value_errors=None, initial_rate_errors=None)


def _with_lagging_rates(inputs: Inputs, rollouts: Rollouts, lag: float) -> Inputs:
    """Returns inputs whose initial rates may be off by as much as they change during a lag.

    Rates are estimated as derivatives; a simulator may have its own between the steps.

    Args:
        inputs: The segments.
        rollouts: What they were made of.
        lag: Part of a time step.
    """
    if lag == 0.0 or inputs.initial_rate_errors is None:
        return inputs
    errors = inputs.initial_rate_errors
    return replace(
        inputs, initial_rate_errors=errors.hypot(errors.new_tensor(lag * rollouts.rate_changes))
    )
