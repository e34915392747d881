"""Whether what a model leaves unexplained is negligible beside what its effects explain."""

from types import SimpleNamespace

import pytest
import torch

from npdr_ppl.discovery.search.rounds import explained, is_negligible, is_something_left


def model(*sizes):
    """Returns a model with a thousand residuals of given sizes in each of several channels."""
    sizes = torch.tensor(sizes, dtype=torch.float64)

    def squares(scale):
        return 1000.0 * (sizes / scale).square()

    return SimpleNamespace(
        fit=SimpleNamespace(scale=sizes), squares=squares, losses=lambda s: 0.5 * squares(s)[None]
    )


def look(hypothesis, *gains):
    """Returns a round whose alarm fires, with the best candidate's gain by channel."""
    by_channel = torch.tensor(gains, dtype=torch.float64)
    alarm = SimpleNamespace(fired=True, gain=float(by_channel.sum()))
    return SimpleNamespace(hypothesis=hypothesis, alarm=alarm, gain_by_channel=by_channel)


# A precise angle, and a velocity in which the effect is hardly seen.
FIRST, FINAL = model(0.1, 1.1), model(0.001, 1.0)


def test_a_misfit_in_a_noisy_channel_is_not_small_beside_that_of_a_precise_one():
    assert explained(FIRST, FINAL) == pytest.approx(1e7, rel=0.01)
    assert is_something_left(look(FIRST), look(FINAL, 0.0, 500.0))
    assert not is_something_left(look(FIRST), look(FINAL, 500.0, 0.0))
    assert is_something_left(look(FIRST), look(FINAL, 2000.0, 0.0))


def test_an_effect_of_a_noisy_channel_is_not_negligible():
    assert not is_negligible(FIRST, FINAL, model(0.001, 0.8))
    assert is_negligible(FIRST, FINAL, model(0.00099, 1.0))
    assert is_negligible(FIRST, FINAL, FINAL)


@pytest.mark.parametrize(("gain", "is_left"), [(19.0, False), (21.0, True)])
def test_over_equal_channels_all_of_the_misfit_counts(gain, is_left):
    first, final = model(10.0, 10.0), model(1.0, 1.0)
    assert explained(first, final) == pytest.approx(2e5, rel=0.02)
    assert is_something_left(look(first), look(final, gain / 2, gain / 2)) is is_left
