"""A posterior's check that takes no time, for tests of other things."""

import contextlib
from dataclasses import replace

from npdr_ppl.posterior import estimator_check
from npdr_ppl.preparation import importance_sampling


@contextlib.contextmanager
def few_draws():
    """Gives the check of a posterior too few draws to agree with the simulator."""
    draws, check = importance_sampling.IMPORTANCE_SAMPLING, estimator_check.ESTIMATOR_CHECK
    importance_sampling.IMPORTANCE_SAMPLING = replace(
        draws, most_iterations=1, draws_per_iteration=8, draws_of_given=8
    )
    estimator_check.ESTIMATOR_CHECK = replace(check, num_draws=16)
    try:
        yield
    finally:
        importance_sampling.IMPORTANCE_SAMPLING = draws
        estimator_check.ESTIMATOR_CHECK = check
