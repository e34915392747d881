"""The chance of naming a cause, against closed forms."""

import itertools
import math

import numpy as np
import pytest

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.planning.chances import chance_of_naming


def even(square, blocks=200):
    """The same squared separation between two causes, spread over many blocks."""
    return {pair: np.full(blocks, square / blocks) for pair in ((0, 1), (1, 0))}


def three(square):
    """The same between three causes."""
    pairs = itertools.permutations(range(3), 2)
    return {pair: np.full(50, square / 50) for pair in pairs}


@pytest.mark.parametrize("distance", [1.0, 3.0, 4.0])
def test_two_causes_are_named_by_the_likelihood_ratio(distance):
    found = chance_of_naming([0.5, 0.5], even(distance**2))
    # The log ratio is normal, of mean d²/2 and deviation d. With many blocks the
    # resampling adds a deviation of about d to it, which makes probabilities less certain.
    limit = math.log(DiscoveryOptions().confidence / (1.0 - DiscoveryOptions().confidence))

    def above(threshold):
        z = (threshold - 0.5 * distance**2) / distance
        return 0.5 * math.erfc(z / math.sqrt(2.0))

    assert found.right <= above(limit) + 0.05
    assert found.right >= above(limit * math.sqrt(1.0 + math.pi * distance**2 / 8.0)) - 0.05
    assert found.wrong <= 1.0 - above(-limit) + 0.05


def test_far_causes_are_named_and_equal_ones_are_not():
    assert chance_of_naming([0.5, 0.5], even(400.0)).right == 1.0
    none = chance_of_naming([0.5, 0.5], even(0.0))
    assert none.right == none.wrong == 0.0


def test_what_is_likely_already_is_named_without_a_recording():
    found = chance_of_naming([0.95, 0.05], even(0.0))
    assert found.right == pytest.approx(0.95) and found.wrong == pytest.approx(0.05)


def test_more_separation_names_more():
    found = [chance_of_naming([0.5, 0.4, 0.1], three(d * d)).right for d in (1.0, 3.0, 5.0, 8.0)]
    assert found == sorted(found) and found[0] < 0.2 and found[-1] > 0.99


def test_the_seed_decides_everything():
    one, two, other = (chance_of_naming([0.6, 0.4], even(9.0), seed=s) for s in (1, 1, 2))
    assert one == two != other
