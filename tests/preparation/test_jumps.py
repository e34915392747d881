"""Segments in which a simulation jumps as parameters change."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from npdr_ppl.preparation.jumps import jumps_of
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit

NAMES = ("mass", "gain")
NUM = 40


class Segments:
    """Segments of a made-up model, of which some can be taken."""

    def __init__(self, numbers):
        self.numbers = numbers
        sites = [SimpleNamespace(name=n, coordinates=slice(k, k + 1)) for k, n in enumerate(NAMES)]
        self.prior = SimpleNamespace(sites=sites)

    def along(self, index):
        return Segments(self.numbers[index])


@dataclass(frozen=True)
class Likelihood:
    """Residuals that are straight lines, and something else in the first segment."""

    segments: Segments
    fit: SegmentFit
    linearisation: Linearisation
    is_noise_declared: bool
    other: object
    variance: float = 1.0

    def whitened(self, z: Tensor) -> Tensor:
        slope = 10.0 * torch.stack((z[:, 0], 2.0 * z[:, 1]), dim=-1)
        rows = slope[:, None].repeat(1, len(self.segments.numbers), 1)
        rows[..., 0] += (self.segments.numbers == 0) * self.other(z[:, :1])
        return rows.flatten(1)


def found(other):
    zeros = torch.zeros(NUM, 2, 1).double()
    fit = SegmentFit(torch.zeros(2).double(), torch.zeros(NUM, 1).double(), torch.ones(2).double())
    now = Linearisation(zeros[..., 0], zeros, zeros)
    return jumps_of(Likelihood(Segments(torch.arange(NUM)), fit, now, False, other))


@pytest.mark.parametrize("place", [-0.007, 0.0, 0.004])
def test_a_jump_that_seems_to_tell_much_is_found(place):
    jumps = found(lambda z: 2.0 * (z > place))
    assert jumps.is_jump.nonzero().tolist() == [[0]]
    assert jumps.misled == ("mass",)
    assert jumps.shares[0] > 0.5 > 1e-6 > jumps.shares[1]
    assert str(jumps).startswith(f"The simulation jumps in 1 of {NUM} segments, as where ")
    assert "many times their intervals: mass. " in str(jumps)


@pytest.mark.parametrize(
    "other",
    [
        lambda z: 0.0 * z,
        lambda z: 300.0 * z,  # steep, but straight
        lambda z: 300.0 * z.clamp_min(0.002),  # a kink, as of dry friction
        lambda z: 300.0 * z.clamp_min(0.006),
        lambda z: 3e4 * z**2,
        lambda z: 1e-3 * (z > 0.0),  # a jump that tells nothing
        lambda z: 0.5 * torch.nan * z,  # a simulation that fails
    ],
    ids=["line", "steep", "kink", "late kink", "bend", "little", "failure"],
)
def test_nothing_else_is_taken_for_a_jump(other):
    jumps = found(other)
    assert not jumps.is_jump.any() and not jumps.misled and str(jumps) == ""
