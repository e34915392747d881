"""Whether what a model leaves unexplained is negligible beside what its effects explain."""

from types import SimpleNamespace

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.search.look import look as look_at
from npdr_ppl.discovery.search.rounds import explained, is_negligible, is_something_left
from npdr_ppl.models.effects import QuadraticDrag


def model(*sizes):
    """Returns a model with a thousand residuals of given sizes in each of several channels."""
    sizes = torch.tensor(sizes, dtype=torch.float64)

    def squares(scale):
        return 1000.0 * (sizes / scale).square()

    return SimpleNamespace(
        fit=SimpleNamespace(scale=sizes), squares=squares, losses=lambda s: 0.5 * squares(s)[None]
    )


def look(hypothesis, *gains, p_value=0.0):
    """Returns a round whose alarm fires, with a candidate for each channel in which it changes."""
    names = [f"law_{k}" for k in range(len(gains))]
    return SimpleNamespace(
        hypothesis=hypothesis,
        alarm=SimpleNamespace(
            gain=max(gains, default=0.0),
            p_values=dict.fromkeys(names, p_value),
            limit=0.01,
            fired=True,
        ),
        ranking=[SimpleNamespace(name=n, gain=g) for n, g in zip(names, gains, strict=True)],
        shares=dict(zip(names, torch.eye(len(gains), dtype=torch.float64), strict=True)),
    )


# A precise angle, and a velocity in which the effect is hardly seen.
FIRST, FINAL = model(0.1, 1.1), model(0.001, 1.0)


def test_a_misfit_in_a_noisy_channel_is_not_small_beside_that_of_a_precise_one():
    assert explained(FIRST, FINAL) == pytest.approx(1e7, rel=0.01)
    assert is_something_left(look(FIRST), look(FINAL, 600.0, 500.0))
    assert not is_something_left(look(FIRST), look(FINAL, 600.0, 0.0))
    assert is_something_left(look(FIRST), look(FINAL, 2000.0, 0.0))
    # The alarm is of another law.
    assert not is_something_left(look(FIRST), look(FINAL, 600.0, 500.0, p_value=0.5))


def test_an_effect_of_a_noisy_channel_is_not_negligible():
    assert not is_negligible(FIRST, FINAL, model(0.001, 0.8))
    assert is_negligible(FIRST, FINAL, model(0.00099, 1.0))
    assert is_negligible(FIRST, FINAL, FINAL)
    assert is_negligible(FIRST, FINAL, model(0.001, 1.0))
    assert is_negligible(FIRST, FINAL, model(0.002, 1.1))


@pytest.mark.parametrize(("gain", "is_left"), [(19.0, False), (21.0, True)])
def test_over_equal_channels_all_of_the_misfit_counts(gain, is_left):
    first, final = model(10.0, 10.0), model(1.0, 1.0)
    assert explained(first, final) == pytest.approx(2e5, rel=0.02)
    assert is_something_left(look(first), look(final, gain, 0.0)) is is_left


def test_shares_of_the_channels_in_what_a_candidate_changes(dragged):
    _, base = dragged
    shares = look_at(base, npdr.DiscoveryOptions(effects=(QuadraticDrag("hinge"),))).shares
    own = shares["hinge.quadratic_drag"]
    assert own.shape == (2,) and float(own.sum()) == pytest.approx(1.0)
    assert float(own.min()) > 0.01
