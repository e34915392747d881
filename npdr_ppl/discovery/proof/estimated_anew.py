"""Parameters that belong to a recording and not to the device, estimated anew on another one.

An incremental encoder gets a new zero each time it is switched on, and the filter of its driver
may be set differently. A prediction of another recording with the old values then has an error
that says nothing about the motion. So these parameters, see
:attr:`~npdr_ppl.language.effects.Effect.per_recording`, are fitted to the held-out recording,
while all others keep their values. Each half of its segments is predicted with the values from the
other half, so that no segment is predicted with the help of its own measurements.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.errors import NpdrError
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit, fit_segments
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts

__all__ = ["ANEW", "EstimatedAnew", "estimated_anew"]

ANEW = "searched", "first half", "second half"
"""Keys of a parameter's values in :meth:`EstimatedAnew.to_dict`."""


@dataclass(frozen=True)
class EstimatedAnew:
    """Parameters that were fitted to a held-out recording, in two halves.

    Attributes:
        shifts: Changes of the reference coordinates for the first half of the segments and for the
            second, ``(2, d)``; zero in the coordinates of all other parameters.
        scales: Root-mean-square residual of each channel in the first half and in the second,
            ``(2, C)``. A filter that is set differently lets another share of the noise pass.
        values: For each such parameter, its value in the recording that was searched, and in the
            first and the second half of the held-out one, by site.
    """

    shifts: Tensor
    scales: Tensor
    values: Mapping[str, tuple[float, float, float]]

    def simulate(self, segments: SegmentModel, z: Tensor, offsets: Tensor, late: Tensor) -> Tensor:
        """Returns measurements with the values of the other half, ``(n, S, K, C)``.

        Args:
            segments: The model along S held-out segments.
            z: Parameters before the shifts, ``(n, d)``.
            offsets: Offsets of the initial states, ``(n, S, m)``.
            late: Whether each segment is in the second half, ``(S,)``.
        """
        parts = self._by_half(
            late,
            lambda index, shift, _: segments.along(index).simulate(z + shift, offsets[:, index]),
        )
        return _joined(parts, late, dim=1)

    def linearise(
        self, segments: SegmentModel, fit: SegmentFit, offsets: Tensor, late: Tensor
    ) -> Linearisation:
        """Returns rough derivatives at the shifted parameters; see :meth:`simulate`."""
        parts = self._by_half(
            late,
            lambda index, shift, scale: segments.along(index).linearise(
                fit.z + shift, offsets[index], scale, is_rough=True
            ),
        )
        return Linearisation(
            *(
                _joined([(index, getattr(part, name)) for index, part in parts], late, dim=0)
                for name in ("residual", "by_parameters", "by_starts")
            )
        )

    def noise_of(self, late: Tensor) -> Tensor:
        """Returns the scale of each segment's residuals in the other half, ``(S, 1, C)``.

        Args:
            late: Whether each segment is in the second half, ``(S,)``.
        """
        return self.scales[(~late).long()][:, None]

    def to_dict(self) -> dict[str, dict[str, float]]:
        """Returns JSON-serialisable values."""
        return {site: dict(zip(ANEW, own, strict=True)) for site, own in self.values.items()}

    def _by_half(
        self, late: Tensor, made: Callable[[Tensor, Tensor, Tensor], Any]
    ) -> list[tuple[Tensor, Any]]:
        """Returns what is made of each half's segments with the values of the other half."""
        halves = ((~late).nonzero()[:, 0], 1), (late.nonzero()[:, 0], 0)
        return [
            (index, made(index, self.shifts[other], self.scales[other]))
            for index, other in halves
            if len(index)
        ]


def estimated_anew(
    hypothesis: Hypothesis, rollouts: Rollouts, options: DataOptions
) -> EstimatedAnew | None:
    """Fits the parameters that belong to a recording to a held-out one.

    Args:
        hypothesis: The model, fitted to another recording.
        rollouts: The held-out recording.
        options: How it is cut into segments.

    Returns:
        ``None`` if there are no such parameters, if there are fewer than two segments, or if the
        model cannot be simulated.
    """
    names = {
        f"{effect.name}.{name}" for effect in hypothesis.effects for name in effect.per_recording
    }
    if not names:
        return None
    segments = SegmentModel(hypothesis.model, rollouts, options)
    own = {site.name: site.coordinates for site in segments.prior.sites if site.name in names}
    num = segments.inputs.num_segments
    if num < 2:
        return None
    z = hypothesis.fit.z.double()
    held = torch.ones(z.shape, dtype=torch.bool)
    for coordinates in own.values():
        held[coordinates] = False
    try:
        found = [
            fit_segments(segments.along(index), z, held=held)
            for index in torch.arange(num).tensor_split(2)
        ]
    except NpdrError:
        return None
    fitted = [fit.z for fit in found]
    every = [segments.prior.to_parameters(each[None]) for each in (z, *fitted)]
    values = {
        site: (first, second, third)
        for site in own
        for first, second, third in [[float(each[site].flatten()[0]) for each in every]]
    }
    scales = torch.stack([fit.scale.double() for fit in found])
    return EstimatedAnew(torch.stack(fitted) - z, scales, values)


def _joined(parts: list[tuple[Tensor, Tensor]], late: Tensor, dim: int) -> Tensor:
    """Returns values of both halves in the order of the segments, which are a dimension."""
    order = torch.cat([index for index, _ in parts]).argsort()
    return torch.cat([values for _, values in parts], dim).index_select(dim, order)
