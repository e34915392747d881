"""Averaged measurements of long recordings."""

import pytest
import torch

from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging


def test_averages_of_neighbours_keep_noise_white_and_slow_changes_distinct():
    segments = SegmentModel(pendulum, swinging(steps=240), DataOptions(None, 30))
    steps = segments.inputs.num_steps
    averaged = segments.averaged(segments.observed.numel() // 3, steps // 3)
    assert averaged.steps_per_average == 3
    scale = torch.ones(segments.observed.shape[-1], dtype=torch.float64)
    torch.manual_seed(0)
    noise = torch.randn(segments.observed.shape, dtype=torch.float64)
    assert averaged.whitened(noise, scale).std() == pytest.approx(1.0, abs=0.05)
    slow = torch.linspace(1.0, 2.0, steps, dtype=torch.float64)[:, None].expand_as(noise)
    distance = averaged.whitened(slow, scale).norm() / segments.whitened(slow, scale).norm()
    assert 0.97 < float(distance) <= 1.0
    assert segments.averaged(segments.observed.numel(), 1) is segments
