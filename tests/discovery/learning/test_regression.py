"""How many terms a formula has, and which."""

import torch

from npdr_ppl.discovery.learning.regression import (
    Formula,
    NormalEquations,
    pareto_front,
    simplest,
)
from npdr_ppl.discovery.learning.term import Term


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


def test_terms_that_are_sums_of_others_are_compared_in_a_precise_recording():
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(4, 60, generator=generator, dtype=torch.float64)
    knots = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)
    hats = (1.0 - 8.0 * (x[..., None] - knots).abs()).clamp_min(0.0)
    columns = torch.cat([torch.ones_like(x)[..., None], x[..., None], hats, hats], dim=-1)
    target = 1.0 + 2.0 * x + 0.1 * (7.0 * x).sin()
    size, widths = 1e15, (1, 1, 9, 9)
    ends = torch.tensor(widths).cumsum(0).tolist()
    terms = tuple(
        Term(f"{end}", ("v",) * w, ("v",) * w, ("1",) * w, frozenset({"v"}), cost=float(w))
        for end, w in zip(ends, widths, strict=True)
    )
    equations = NormalEquations(
        terms,
        tuple(slice(end - w, end) for end, w in zip(ends, widths, strict=True)),
        torch.ones(20, dtype=torch.float64),
        size * columns.mT @ columns,
        size * (columns.mT @ target[..., None])[..., 0],
        size * target.square().sum(-1),
        torch.full((20,), 0.1, dtype=torch.float64),
        0,
        1.0,
    )
    front = equations.front()
    assert [len(formula.terms) for formula in front] == [0, 1, 2, 3, 4]
    assert front[1].terms[0].cost == 9.0
    assert front[1].misfit < 1e-3 * front[0].misfit
    assert all(bool(formula.errors.isfinite().all()) for formula in front)


def test_formulas_are_as_close_as_direct_least_squares():
    generator = torch.Generator().manual_seed(1)
    columns = torch.randn(4, 50, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(4, 50, generator=generator, dtype=torch.float64)
    target = columns @ torch.tensor([5.0, 0.0, -2.0], dtype=torch.float64) + noise
    terms = tuple(Term(k, ("v",), ("v",), ("1",), frozenset({"v"})) for k in "abc")
    equations = NormalEquations(
        terms,
        (slice(0, 1), slice(1, 2), slice(2, 3)),
        torch.ones(3, dtype=torch.float64),
        columns.mT @ columns,
        (columns.mT @ target[..., None])[..., 0],
        target.square().sum(-1),
        torch.full((3,), 1e-9, dtype=torch.float64),
        0,
        1.0,
    )
    front = equations.front()
    assert [term.key for term in simplest(front).terms] == ["a", "c"]
    own = columns[..., [0, 2]]
    whole = torch.linalg.lstsq(own.flatten(0, 1), target.flatten()[:, None])
    assert torch.allclose(front[2].coefficients, whole.solution[:, 0], atol=1e-6)
    for fold in range(4):
        others = [k for k in range(4) if k != fold]
        solution = torch.linalg.lstsq(
            own[others].flatten(0, 1), target[others].flatten()[:, None]
        ).solution[:, 0]
        expected = (target[fold] - own[fold] @ solution).square().sum()
        assert torch.allclose(front[2].errors[fold], expected, rtol=1e-6)
