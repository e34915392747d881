"""A model along a recording's segments, and its derivatives.

Derivatives by parameters and by the offsets of initial states are finite differences. They are
computed in one batch of simulations for all parameters, segments and components of initial states.
The simulator stays a black box.
"""

import math
from functools import cached_property, partial
from typing import Self

import torch
from torch import Tensor

from npdr_ppl.errors import NpdrError
from npdr_ppl.language.handlers import with_coarser_steps
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.initial_states import InitialStates, error_factors, estimate_starts
from npdr_ppl.preparation.linearisation import Linearisation, difference_quotients
from npdr_ppl.preparation.settings import LINEARISATION
from npdr_ppl.preparation.simulated_segments import SimulatedSegments

__all__ = ["SegmentModel", "has_closest_fit"]


class SegmentModel(SimulatedSegments):
    """A model with one black-box site along a recording, that can be linearised.

    Arguments and attributes are those of
    :class:`~npdr_ppl.preparation.simulated_segments.SimulatedSegments`.
    """

    def _start_from(self, starts: InitialStates | None) -> None:
        super()._start_from(starts)
        self.__dict__.pop("_without_influence", None)

    def estimated_starts(self, z: Tensor, scale: Tensor) -> InitialStates | None:
        """Estimates the initial states of the segments, with their errors, along a fitted motion.

        Args:
            z: Parameters, ``(d,)``.
            scale: Standard deviation of each channel's residuals, ``(C,)``.

        Returns:
            The initial states; ``None`` if they are certain, or if simulations from the estimate
            fail.
        """
        starts = estimate_starts(self.black_box(z[None]), self._smoothed, self.rollouts)
        if starts is None:
            return None
        segments = self.starting_from(starts)
        now = segments.linearise(z, segments.no_offsets, scale, is_rough=True)
        if not now.is_finite:
            return None
        return starts.scaled(segments.inputs, error_factors(now.residual, now.by_starts))

    def in_coarser_steps(self, z: Tensor, offsets: Tensor, num_draws: float = math.inf) -> Self:
        """Returns a cheaper model with the same residuals at a point, and similar ones around it.

        It takes the simulator's coarser steps. What they miss at the point is taken from the
        measurements.

        Args:
            z: Parameters, ``(d,)``.
            offsets: Offsets of the initial states, ``(S, m)``.
            num_draws: Number of simulations of the whole recording that it is meant for.

        Returns:
            This model if there are no coarser steps, if they save nothing, or if they are
            unstable: simulations at the point fail, or miss more than the recording's size.
        """
        num_simulations = num_draws * self.inputs.num_segments
        if self.simulator.with_coarser_steps(num_simulations, self.inputs.time_step) is None:
            return self
        coarser = self.with_model(with_coarser_steps(self.model))
        here = z[None], offsets[None]
        missed = (self.simulate(*here) - coarser.simulate(*here))[0]
        largest = (self.observed * self.is_measured).abs().amax((0, 1))
        if not bool((self.root_mean_square(missed) <= largest).all()):
            return self
        coarser.observed = self.observed - missed
        if "_without_influence" in self.__dict__:
            coarser.__dict__["_without_influence"] = self._without_influence
        return coarser

    def linearise(
        self, z: Tensor, offsets: Tensor, scale: Tensor, *, is_rough: bool = False
    ) -> Linearisation:
        """Returns residuals and derivatives at one point.

        Args:
            z: Parameters, ``(d,)``.
            offsets: Offsets of the initial states, ``(S, m)``.
            scale: Standard deviation of each channel's residuals, ``(C,)``.
            is_rough: Whether one-sided differences will do, at half the price.
        """
        return self.corrected(z, offsets, scale, is_rough=is_rough)[1]

    def corrected(
        self, z: Tensor, offsets: Tensor, scale: Tensor, *, is_rough: bool = False
    ) -> tuple[Self, Linearisation]:
        """Returns a model that is like this one near a point, and its linearisation there.

        It is :meth:`in_coarser_steps`, or this model if that cannot be linearised. Residuals of
        the linearisation are this model's own; see :meth:`linearise`.
        """
        num_draws = (1 if is_rough else 2) * (len(z) + self.num_offsets)
        coarser = self.in_coarser_steps(z, offsets, num_draws)
        if coarser is not self:
            found = coarser._linearised(z, offsets, scale, is_rough=is_rough)
            self.__dict__["_without_influence"] = coarser._without_influence
            if found.is_finite:
                return coarser, found
        return self, self._linearised(z, offsets, scale, is_rough=is_rough)

    def _linearised(
        self, z: Tensor, offsets: Tensor, scale: Tensor, *, is_rough: bool
    ) -> Linearisation:
        """Returns residuals and derivatives in this model's steps; see :meth:`linearise`."""
        step, idle = LINEARISATION.initial_state_step, self._without_influence
        eye = torch.eye(self.num_offsets, dtype=torch.float64)
        moves = step * eye[~idle]
        # One simulation shifts all the others at once, to confirm that they have no influence.
        check = step * idle.double()[None] if bool(idle.any()) else moves[:0]
        residuals = partial(self.residuals, scale=scale)
        by_z, by_start, (here, *checked) = difference_quotients(
            residuals, z, offsets, moves, check, is_rough=is_rough
        )
        if checked and not torch.equal(checked[0].nan_to_num(), here.nan_to_num()):
            # The simulator uses them in another way, so that all are simulated from now on.
            self.__dict__["_without_influence"] = torch.zeros_like(idle)
            return self._linearised(z, offsets, scale, is_rough=is_rough)
        starts = here.new_zeros(len(eye), *here.shape)
        starts[~idle] = by_start
        return Linearisation(here, by_z.permute(1, 2, 0), starts.permute(1, 2, 0))

    @cached_property
    def _without_influence(self) -> Tensor:
        """Mask ``(m,)`` of the offsets that move no initial state of the simulator.

        Such are those of velocities that are estimated from positions in all segments.
        """
        eye = torch.eye(self.num_offsets, dtype=torch.float64)[:, None]
        try:
            moved, unmoved = (
                self.simulator.initial_states(self._shifted(offsets))
                for offsets in (eye.expand(-1, self.inputs.num_segments, -1), self.no_offsets)
            )
        except NpdrError:  # the simulator finds its initial states in another way
            return torch.zeros(self.num_offsets, dtype=torch.bool)
        shape = self.num_offsets, self.inputs.num_segments
        return ~torch.stack(
            [(a != b).expand(shape).any(1) for a, b in zip(moved, unmoved, strict=True)]
        ).any(0)


def has_closest_fit(prior: Prior) -> bool:
    """Returns whether a model has a closest fit: it has one deterministic simulator.

    A simulator inside plates has several sets of parameters along the same recording.

    Args:
        prior: The model's prior along the recording.
    """
    boxes = [*prior.black_boxes.values()]
    return (
        len(boxes) == 1
        and isinstance(boxes[0], SimulatorBlackBox)
        and boxes[0].simulator.is_deterministic
        and boxes[0].batch_shape == torch.Size()
    )
