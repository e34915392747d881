"""Averaged measurements of long recordings, and derivatives by initial states."""

import pytest
import torch

from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import LINEARISATION
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


@pytest.fixture
def segments():
    return SegmentModel(pendulum, swinging(steps=240), DataOptions(None, 30))


def differences(segments, z, offsets, scale, *, is_rough):
    """Returns the simulation's derivatives by every offset, one simulation after another."""
    step = LINEARISATION.initial_state_step
    columns = []
    for move in step * torch.eye(segments.num_offsets, dtype=torch.float64):
        right = segments.residuals(z[None], offsets[None] + move, scale)[0]
        back = torch.zeros_like(move) if is_rough else -move
        left = segments.residuals(z[None], offsets[None] + back, scale)[0]
        columns.append((left - right) / (step if is_rough else 2.0 * step))
    return torch.stack(columns, dim=-1)


@pytest.mark.parametrize("is_rough", [False, True])
@pytest.mark.parametrize("is_mistaken", [False, True])
def test_offsets_that_move_no_initial_state_are_not_simulated(
    segments, monkeypatch, is_rough, is_mistaken
):
    idle = segments._without_influence
    # A velocity is estimated from positions: its own measurement and its rate have no influence.
    assert 0 < int(idle.sum()) < segments.num_offsets
    num_moved = int((~idle).sum())
    if is_mistaken:  # as where a simulator of one's own uses them in another way
        segments.__dict__["_without_influence"] = torch.ones_like(idle)
    generator = torch.Generator().manual_seed(0)
    offsets = torch.randn(segments.no_offsets.shape, generator=generator).double()
    z = torch.full((segments.prior.num_parameters,), 0.1, dtype=torch.float64)
    scale = torch.full((segments.observed.shape[-1],), 1e-2, dtype=torch.float64)
    rows = []
    residuals = SegmentModel.residuals

    def counted(self, z, *others, **options):
        rows.append(len(z))
        return residuals(self, z, *others, **options)

    monkeypatch.setattr(SegmentModel, "residuals", counted)
    found = segments.linearise(z, offsets, scale, is_rough=is_rough).by_starts
    if not is_mistaken:  # the point itself, the confirmation, and a difference to each side
        assert rows == [2 + (1 if is_rough else 2) * (len(z) + num_moved)]
    monkeypatch.undo()
    wanted = differences(segments, z, offsets, scale, is_rough=is_rough)
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9 * float(wanted.abs().max()))


def test_corrected_derivatives_explain_the_last_step_and_leave_others_alone(segments):
    d, m = segments.prior.num_parameters, segments.num_offsets
    scale = torch.full((segments.observed.shape[-1],), 1e-2, dtype=torch.float64)
    z, offsets = torch.zeros(d, dtype=torch.float64), segments.no_offsets
    now = segments.linearise(z, offsets, scale)
    generator = torch.Generator().manual_seed(0)
    step = 0.3 * torch.randn(d, generator=generator).double()
    moves = 0.3 * torch.randn(len(offsets), m, generator=generator).double()
    there = segments.residuals((z + step)[None], (offsets + moves)[None], scale)[0]
    found = now.updated(there, step, moves)

    def change(linearisation, step, moves):
        by_start = (linearisation.by_starts @ moves[..., None])[..., 0]
        return linearisation.by_parameters @ step + by_start

    torch.testing.assert_close(change(found, step, moves), now.residual - there)
    # A segment's own directions at right angles to the step keep their derivatives.
    aside = torch.zeros_like(moves)
    aside[:, 0], aside[:, 1] = moves[:, 1], -moves[:, 0]
    still = torch.zeros_like(step)
    torch.testing.assert_close(change(found, still, aside), change(now, still, aside))


def test_derivatives_in_smaller_units_are_larger(segments):
    z, offsets = torch.zeros(segments.prior.num_parameters).double(), segments.no_offsets
    scale = torch.tensor([1e-2, 3e-2], dtype=torch.float64)[: segments.observed.shape[-1]]
    factor = torch.tensor([2.0, 5.0], dtype=torch.float64)[: len(scale)]
    found = segments.linearise(z, offsets, scale).rescaled(factor)
    expected = segments.linearise(z, offsets, scale / factor)
    for name in ("residual", "by_parameters", "by_starts"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))
