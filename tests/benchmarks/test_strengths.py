"""Strengths of hidden effects are set by what the refitted model leaves of them."""

import pytest
from discovery import NEARLY, meet_separation

from npdr_ppl.errors import DataError


@pytest.mark.parametrize(
    "separates",
    [
        lambda strength: 3.0 * strength,
        lambda strength: 0.001 * strength**3,  # elasticity
        lambda strength: 200.0 * strength,
        lambda strength: max(0.0, 40.0 * (strength - 0.4)),  # a stop that is hit from 0.4 on
        lambda strength: min(30.0, 8.0 * strength),  # as of what others imitate
    ],
)
def test_a_strength_has_the_separation_or_little_more(separates):
    strength, found = meet_separation(separates, 10.0)
    assert found == separates(strength)
    assert 10.0 <= found <= 10.0 * NEARLY


def test_a_truth_that_is_unstable_is_too_strong():
    def separates(strength):
        if strength > 0.5:
            raise DataError("angle is nan at step 228")
        return 30.0 * strength

    assert meet_separation(separates, 10.0)[0] < 0.5


def test_what_is_imitated_at_any_strength_has_none():
    with pytest.raises(ValueError, match=r"the most was 4\.0"):
        meet_separation(lambda strength: min(4.0, strength), 10.0, strongest=30.0)
