"""How many terms a formula has, and which."""

import torch

from npdr_ppl.discovery.learning.regression import Formula, pareto_front, simplest
from npdr_ppl.discovery.learning.terms import Term


def formula(cost, *errors):
    """A formula of one term with a complexity, or none, and the errors of its folds."""
    term = Term("x", ("v",), ("v",), ("1",), frozenset({"v"}), cost=cost)
    values = torch.tensor(errors, dtype=torch.float64)
    return Formula((term,) if cost else (), torch.zeros(1), values, float(values.sum()))


NONE = formula(0.0, 100.0, 110.0, 90.0, 105.0)


def test_the_simpler_of_two_formulas_within_one_standard_error_is_taken():
    simple, best = formula(1.0, 10.0, 12.0, 9.0, 11.0), formula(5.0, 9.0, 12.5, 8.0, 11.5)
    assert simplest([NONE, simple, best]) is simple


def test_a_formula_that_is_better_in_every_fold_is_taken():
    simple, best = formula(1.0, 30.0, 31.0, 29.0, 30.0), formula(5.0, 10.0, 11.0, 9.0, 10.0)
    assert simplest([NONE, simple, best]) is best


def test_an_improvement_that_is_a_negligible_share_is_left_out():
    nothing = formula(0.0, 1e6, 1e6, 1e6, 1e6)
    simple, best = (
        formula(1.0, 110.0, 110.0, 110.0, 110.0),
        formula(5.0, 100.0, 100.0, 100.0, 100.0),
    )
    assert simplest([nothing, simple, best]) is simple


def test_no_law_is_taken_if_none_predicts_better():
    worse = formula(1.0, 101.0, 111.0, 91.0, 106.0)
    assert simplest([NONE, worse]) is NONE


def test_a_law_that_acts_in_one_fold_is_not_mistaken_for_none():
    rare = formula(1.0, 100.0, 110.0, 90.0, 20.0)
    assert simplest([NONE, rare]) is rare


def test_the_front_has_only_formulas_that_no_simpler_one_predicts_as_well_as():
    simple, middle, best = formula(1.0, 10.0), formula(2.0, 11.0), formula(3.0, 5.0)
    assert pareto_front([best, middle, simple]) == [simple, best]
