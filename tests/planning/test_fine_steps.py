"""Plans take finer integration steps where the errors of coarse ones differ between causes."""

from dataclasses import replace

import numpy as np
import pytest

from npdr_ppl.language.handlers import num_finer_steps
from npdr_ppl.planning import fine_steps
from npdr_ppl.planning.fine_steps import in_fine_steps
from npdr_ppl.planning.judging import Judge
from npdr_ppl.planning.settings import PLANNING


def num_refined(known):
    return {num_finer_steps(cause.model) for cause in known.causes}


@pytest.mark.slow
def test_steps_are_refined_until_their_errors_are_small_or_there_are_no_finer_ones(
    surviving, monkeypatch
):
    known, limits = surviving
    # The equations' Runge-Kutta steps of 10 ms are fine for a pendulum of 1 Hz.
    assert in_fine_steps(known, limits, 0) is known
    tiny = replace(PLANNING, greatest_step_error=0.0)
    monkeypatch.setattr(fine_steps, "PLANNING", tiny)
    finest = in_fine_steps(known, limits, 0)
    assert num_refined(finest) == {n + 1 for n in num_refined(known)}
    assert in_fine_steps(finest, limits, 0) is finest


@pytest.mark.slow
def test_steps_are_kept_where_no_candidate_can_be_simulated(surviving, monkeypatch):
    known, limits = surviving
    monkeypatch.setattr(Judge, "_simulated", fails)
    assert in_fine_steps(known, limits, 0) is known


def fails(judge, box, inputs):
    return np.full((*inputs.actions.shape[:2], len(judge.channels)), np.nan)
