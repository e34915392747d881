"""The states that segments start from, where a fitted model helps to find them."""

import numpy as np
import pytest
import torch
from hidden_rigs import RIGS

import npdr_ppl as npdr
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.initial_states import error_draws, error_factors, estimate_starts
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts.states import ERROR_RATIOS, estimate_departures
from tests.helpers.pendulum_recordings import TRUTH, jerked
from tests.helpers.rig_recordings import recording_of


def test_what_departs_smoothly_from_a_prediction_is_found():
    """The prediction's own kinks, and where its windows begin, do not matter."""
    time = np.arange(200) * 0.01
    kinked = np.abs(np.sin(9.0 * time))[:, None]
    readings = kinked + (0.3 + 0.2 * time - 0.5 * time**3)[:, None]
    steps, first = np.array([50, 90, 100, 199]), np.array([10, 70, 60, 150])
    windows = [kinked[a : b + 1] for a, b in zip(first, steps, strict=True)]
    found = estimate_departures(readings, windows, first, steps, 0.01)
    then = time[steps]
    np.testing.assert_allclose(found.values[:, 0], 0.3 + 0.2 * then - 0.5 * then**3, atol=1e-9)
    np.testing.assert_allclose(found.rates[:, 0], 0.2 - 1.5 * then**2, atol=1e-7)


def test_where_only_the_prediction_ends_a_window_errors_are_standard_errors():
    generator = np.random.default_rng(0)
    steps = np.arange(40, 4000, 40)
    readings = 1e-3 * generator.standard_normal((4001, 1))
    still = [np.zeros((41, 1))] * len(steps)
    found = estimate_departures(readings, still, steps - 40, steps, 0.01)
    z = found.values / found.value_errors
    assert 0.8 < np.sqrt(np.square(z).mean()) < 1.2
    # Of the last value of a cubic through the 38 latest readings.
    weights = np.linalg.pinv(np.vander(np.arange(-37.0, 1.0), 4, increasing=True))[0]
    expected = 1e-3 * np.linalg.norm(weights)
    assert np.median(found.value_errors) == pytest.approx(expected, rel=0.1)
    bent = [np.abs(np.arange(-20.0, 21.0))[:, None]] * len(steps)
    stopped = estimate_departures(readings, bent, steps - 40, steps, 0.01)
    assert np.median(stopped.value_errors) > ERROR_RATIOS[0] * np.median(found.value_errors)


def test_errors_are_scaled_to_what_the_offsets_show():
    generator = torch.Generator().manual_seed(0)
    by_starts = 5.0 * torch.randn(200, 20, 3, generator=generator).double()
    true = torch.tensor([0.5, 1.0, 3.0]).double()
    offsets = true * torch.randn(200, 3, generator=generator).double()
    residual = (by_starts @ offsets[..., None])[..., 0]
    residual = residual + torch.randn(residual.shape, generator=generator).double()
    torch.testing.assert_close(error_factors(residual, by_starts), true, rtol=0.15, atol=0.0)


def test_segments_whose_simulation_explodes_have_no_say_in_the_errors():
    generator = torch.Generator().manual_seed(0)
    by_starts = torch.randn(50, 20, 2, generator=generator).double()
    residual = 3.0 * torch.randn(50, 20, generator=generator).double()
    plain = error_factors(residual[1:], by_starts[1:])
    by_starts[0] = 1e100  # 1 + Gᵀ G is singular in double precision
    torch.testing.assert_close(error_factors(residual, by_starts), plain)
    torch.testing.assert_close(
        error_factors(residual[:1], by_starts[:1]), torch.ones(2, dtype=torch.float64)
    )


@pytest.mark.parametrize("name", ["pendulum", "emps"])
def test_starts_along_a_fit_are_as_far_off_as_they_say_and_command_changes_do_not_bias_them(name):
    rig = RIGS[name]
    recording = recording_of(name)
    rollouts = recording.rollouts
    inputs = Searcher(rig.model, rollouts, npdr.DiscoveryOptions()).fit_base().segments.inputs
    later = inputs.start > 0
    at = list(zip(inputs.rollout[later].tolist(), inputs.start[later].tolist(), strict=True))
    value, rate = torch.tensor(np.array([recording.true_states[r][k] for r, k in at])).T

    def spread(known, error, true):
        return float((((known[later, 0] - true) / error[later, 0]) ** 2).mean().sqrt())

    for found in (
        spread(inputs.initial_values, inputs.initial_value_errors, value),
        spread(inputs.initial_rates, inputs.initial_rate_errors, rate),
    ):
        assert 0.75 < found < 1.3
    change = torch.tensor(
        np.array([rollouts.actions[r][k, 0] - rollouts.actions[r][k - 1, 0] for r, k in at])
    )

    def bias(known):
        """Share of the rates' errors that goes with the command's change at the start."""
        error = known.initial_rates[later, 0] - rate
        return float((error @ change).square() / (error @ error) / (change @ change))

    assert bias(inputs) < 0.05


def test_rates_are_right_where_commands_jump_although_only_angles_were_recorded():
    rollouts, velocities = jerked(every=20)
    fine = with_finer_steps(pendulum)  # of order four, whose velocities are those at each step
    segments = SegmentModel(fine, rollouts, npdr.DataOptions(segment_length=20))
    z = segments.place_of({name: torch.tensor(value) for name, value in TRUTH.items()})
    starts = estimate_starts(segments.black_box(z[None]), segments.inputs, rollouts)
    later = segments.inputs.start[1:]
    error = starts.rates[1:, 0] - torch.tensor(velocities)[later]
    assert float((error / starts.rate_errors[1:, 0]).square().mean().sqrt()) < 1.3
    # A central difference would be off by a quarter of the change of acceleration in a step.
    assert float(error.abs().max()) < 0.01


def test_draws_of_the_errors_have_the_moments_of_their_posterior():
    generator = torch.Generator().manual_seed(0)
    by_starts = torch.randn(1, 6, 2, generator=generator).double().expand(4000, 6, 2)
    truth, factors = torch.tensor([1.5, -0.5]).double(), torch.tensor([2.0, 0.5]).double()
    noise = torch.randn(6, generator=generator).double()
    residual = (noise - by_starts[0] @ truth).expand(4000, 6)
    inverse = torch.linalg.inv(by_starts[0].T @ by_starts[0] + (1.0 / factors.square()).diag())
    expected = -inverse @ by_starts[0].T @ residual[0]
    with seeded(0, "draws"):
        drawn = error_draws(residual, by_starts, factors)
    # Five standard errors of 4000 draws.
    assert torch.allclose(drawn.mean(0), expected, atol=5.0 * float(inverse.max() / 4000) ** 0.5)
    assert torch.allclose(drawn.T.cov(), inverse, atol=0.1 * float(inverse.max()))


def test_draws_of_the_errors_where_a_simulation_diverges_are_of_the_prior():
    residual, by_starts = torch.zeros(4000, 3).double(), torch.ones(4000, 3, 1).double()
    residual[::2] = torch.inf
    with seeded(0, "draws"):
        drawn = error_draws(residual, by_starts, torch.tensor([2.0]).double())
    assert float(drawn[::2].std()) == pytest.approx(2.0, rel=0.1)
    assert float(drawn[1::2].std()) == pytest.approx((1.0 / (3.0 + 1.0 / 4.0)) ** 0.5, rel=0.1)
