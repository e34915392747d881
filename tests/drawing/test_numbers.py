"""Numbers and intervals have as many digits as their uncertainty leaves."""

import math

import pytest

from npdr_ppl.drawing.numbers import interval, uncertain


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (0.0500412, 2.1e-5, "0.050041"),
        (46.0912, 0.027, "46.091"),
        (349.612, 0.28, "349.61"),
        (1.23456, 0.5, "1.235"),
        (1.05e-7, 8e-12, "1.05e-07"),
        (-2.0000456789, 1e-12, "-2.0000457"),
        (0.0, 0.1, "0"),
        (1.23456, 0.0, "1.235"),
        (1.23456, math.nan, "1.235"),
        (None, 0.1, "–"),
    ],
)
def test_a_number_has_two_digits_of_its_uncertainty(value, spread, text):
    assert uncertain(value, spread) == text


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ((0.0499961, 0.0500812), "0.049996 … 0.050081"),
        ((1.04998e-7, 1.05013e-7), "1.04998e-07 … 1.05013e-07"),
        ((-1.0, 2.0), "-1 … 2"),
        ((None, 2.0), "– … 2"),
        ((), "–"),
    ],
)
def test_the_bounds_of_an_interval_can_be_told_apart(bounds, text):
    assert interval(bounds) == text
