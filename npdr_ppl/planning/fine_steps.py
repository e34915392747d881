"""Integration steps that are fine enough for a plan.

A command that is late by half a step changes in the middle of one, which coarse steps simulate
with an error. Late measurements leave the commands at the ends of steps, without this error. So a
search would find the motion where the error is greatest, and would take it for a difference of
the causes.
"""

from dataclasses import replace

import numpy as np

from npdr_ppl.errors import NpdrError
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.planning.causes import Known
from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.judging import Judge
from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.search import within_limits
from npdr_ppl.planning.settings import PLANNING

__all__ = ["in_fine_steps"]


def in_fine_steps(known: Known, limits: Limits, seed: int) -> Known:
    """Returns causes in steps whose errors hardly differ between them, or in the finest ones.

    Their parameters remain those of the steps in which they were fitted. The steps are kept if no
    random candidate keeps the limits, or if finer ones cannot be simulated.

    Args:
        known: The causes, at the time step of the limits.
        limits: What the robot may do.
        seed: Seed of the candidates.
    """
    excitations = Excitations(limits, np.random.default_rng(seed))
    made = excitations.random(PLANNING.batch)
    while (finer := _in_finer_steps(known)) is not None:
        judge = Judge(known, limits, seed)
        kept, played = within_limits(excitations, judge, made)
        few = range(min(len(kept), PLANNING.num_smoothed))
        if not few:
            return known
        try:
            changes = judge.differing_changes(played.chosen(few), finer)
        except NpdrError:
            return known
        if not bool((changes > PLANNING.greatest_step_error).any()):
            return known
        known = finer
    return known


def _in_finer_steps(known: Known) -> Known | None:
    """Returns the causes in their next finer steps; ``None`` if one has none."""
    if any(cause.simulator.with_finer_steps() is None for cause in known.causes):
        return None
    causes = (replace(cause, model=with_finer_steps(cause.model)) for cause in known.causes)
    return replace(known, causes=tuple(causes))
