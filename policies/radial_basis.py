"""Normalised Gaussian radial basis functions of the observations."""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.policies.base import Policy, PolicyParameter

__all__ = ["RadialBasis"]

Ranges = Sequence[tuple[float, float]]


class RadialBasis(Policy):
    """A weighted mean of the values at M centres c_m, with widths σ_j per observation o_j.

        u = Σ_m w_m g_m(o) / Σ_m g_m(o),   g_m(o) = exp(−½ Σ_j ((o_j − c_mj)/σ_j)²)

    Far from all centres the value at the nearest centre dominates. A command is a mean and lies
    between the least and the greatest w. It stays within an action's limits if all values do.

    Args:
        observations: Names of the O sensor channels.
        actions: Names of the A action channels.
        centres: Centres in the observations' units, shape ``(M, O)``.
        widths: σ in the observations' units, O numbers.
        limits: Least and greatest command of each action; bounds of its values.
        parameters: The values of the first action at all centres, then those of the second …,
            shape ``(..., A M)``; named ``<action>.centre_<m>``; mid-range by default.
    """

    def __init__(
        self,
        observations: tuple[str, ...],
        actions: tuple[str, ...],
        centres: Tensor,
        widths: Sequence[float],
        limits: Ranges,
        *,
        parameters: Tensor | None = None,
    ) -> None:
        if centres.ndim != 2 or centres.shape[-1] != len(observations):
            raise ShapeError(
                f"Centres for {', '.join(observations)} have the shape (centres, "
                f"{len(observations)}), but got {centres.shape=}."
            )
        if len(widths) != len(observations) or not all(width > 0.0 for width in widths):
            raise ModelError(
                f"Widths are {len(observations)} positive numbers, one per observation, but got "
                f"{tuple(widths)}."
            )
        if len(limits) != len(actions):
            raise ShapeError(f"{len(actions)} actions need as many limits, got {len(limits)}.")
        self.observations = observations
        self.actions = actions
        # Numbers instead of tensors: they work with any floating type and device.
        self.centres: tuple[tuple[float, ...], ...] = tuple(map(tuple, centres.tolist()))
        self.widths = tuple(widths)
        self.parameter_info = tuple(
            PolicyParameter(f"{action}.centre_{m}", 0.5 * (lower + upper), lower, upper)
            for action, (lower, upper) in zip(actions, limits, strict=True)
            for m in range(len(centres))
        )
        super().__init__(parameters)

    @classmethod
    def on_grid(
        cls,
        observations: tuple[str, ...],
        actions: tuple[str, ...],
        ranges: Ranges,
        counts: Sequence[int],
        limits: Ranges,
        *,
        parameters: Tensor | None = None,
    ) -> Self:
        """Returns centres on a grid, one grid spacing wide.

        Args:
            observations: Names of the O sensor channels.
            actions: Names of the action channels.
            ranges: First and last centre along each observation.
            counts: Number of centres along each observation, at least 2 each.
            limits: Least and greatest command of each action.
            parameters: The values.
        """
        if min(counts) < 2 or not len(counts) == len(ranges) == len(observations):
            raise ModelError(
                f"A grid over {', '.join(observations)} needs {len(observations)} ranges and "
                f"counts of at least 2, but got {tuple(ranges)} and {tuple(counts)}."
            )
        axes = [
            torch.linspace(lower, upper, count, dtype=torch.float64).tolist()
            for (lower, upper), count in zip(ranges, counts, strict=True)
        ]
        widths = [axis[1] - axis[0] for axis in axes]
        centres = torch.tensor(list(itertools.product(*axes)), dtype=torch.float64)
        return cls(observations, actions, centres, widths, limits, parameters=parameters)

    @classmethod
    def at_random(
        cls,
        observations: tuple[str, ...],
        actions: tuple[str, ...],
        ranges: Ranges,
        num_centres: int,
        limits: Ranges,
        *,
        seed: int = 0,
        parameters: Tensor | None = None,
    ) -> Self:
        """Returns uniformly drawn centres, as wide as the spacing of a grid with as many centres.

        The number of centres of a grid grows exponentially with the number of observations. Here
        it can be chosen freely.

        Args:
            observations: Names of the O sensor channels.
            actions: Names of the action channels.
            ranges: Least and greatest centre along each observation.
            num_centres: Number of centres M.
            limits: Least and greatest command of each action.
            seed: Seed of the centres.
            parameters: The values.
        """
        low, high = torch.tensor(ranges, dtype=torch.float64).unbind(-1)
        generator = torch.Generator().manual_seed(seed)
        share = torch.rand(num_centres, len(low), generator=generator, dtype=torch.float64)
        widths = (high - low) * num_centres ** (-1.0 / len(low))
        centres = low + (high - low) * share
        return cls(observations, actions, centres, widths.tolist(), limits, parameters=parameters)

    def constants(self, domain: Mapping[str, Tensor]) -> tuple[tuple[Tensor, ...], ...]:
        """Returns the values at the centres, per action."""
        values = self.parameters.unflatten(-1, (len(self.actions), -1)).unbind(-2)
        return tuple(tuple(value.unbind(-1)) for value in values)

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: tuple[tuple[Tensor, ...], ...],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the commands."""
        # Compiled loops fuse one operation per number, but not a stack and a softmax.
        logarithms = []
        for centre in self.centres:
            # log g without −½ Σ (o/σ)², which all centres share and which cancels in the mean.
            slopes = [c / width**2 for c, width in zip(centre, self.widths, strict=True)]
            offset = -0.5 * sum(c * slope for c, slope in zip(centre, slopes, strict=True))
            logarithm = torch.full_like(observation[0], offset)
            for o, slope in zip(observation, slopes, strict=True):
                logarithm = torch.add(logarithm, o, alpha=slope)
            logarithms.append(logarithm)
        peak = functools.reduce(torch.maximum, logarithms)  # so that no exponential overflows
        basis = tuple(torch.exp(logarithm - peak) for logarithm in logarithms)
        total = functools.reduce(torch.add, basis)
        commands = []
        for values in constants:
            command = torch.zeros_like(total)
            for value, share in zip(values, basis, strict=True):
                command = torch.addcmul(command, value, share)
            commands.append(command / total)
        return tuple(commands), memory
