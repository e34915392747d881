"""Hidden rigs: recordings of rigs that the package has no model of, for discovery to explain.

    from hidden_rigs import cases

    for case in cases("one", seeds=range(3), rigs=["emps"], strengths=[0.5, 1.0, 2.0]):
        found = npdr.discover(case.model, case.fit, holdout=case.holdout, seed=case.seed)

The truth comes from equations, integrator and laws of effects that are written here a second time,
in NumPy and in other forms than the package's. Nothing in here imports the package's engines or
effects but :mod:`hidden_rigs.under_test`, which holds the models to be judged.
"""

from hidden_rigs.cases import (
    CONDITIONS,
    Case,
    Condition,
    cases,
    hold_out_again,
    make_case,
    places,
    play,
)
from hidden_rigs.hidden import Hidden
from hidden_rigs.rig import Place
from hidden_rigs.rigs import RIGS

__all__ = [
    "CONDITIONS",
    "RIGS",
    "Case",
    "Condition",
    "Hidden",
    "Place",
    "cases",
    "hold_out_again",
    "make_case",
    "places",
    "play",
]
