"""The choice of a plan's rollouts among candidates."""

from npdr_ppl.planning.selection import greedy

WORTH = {0: 5.0, 1: 3.0, 2: 1.0}


def worth(chosen):
    return sum(WORTH[k] for k in chosen)


def test_rollouts_differ_as_long_as_there_are_candidates():
    """The errors of encoders are the same whenever a rollout is repeated."""
    chosen = greedy([0, 1, 2], worth, lambda chosen: False, most=3, num_distinct=3)
    assert chosen == [0, 1, 2]
    more = greedy([0, 1, 2], worth, lambda chosen: False, most=5, num_distinct=5)
    assert more == [0, 1, 2, 0, 0]


def test_rollouts_that_are_only_counted_may_be_repeated():
    chosen = greedy([0, 1, 2], worth, lambda chosen: worth(chosen) > 18.0, most=9, num_distinct=2)
    assert chosen == [0, 1, 0, 0, 0]
