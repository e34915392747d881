"""Parts of the search in several processes."""

import os
import sys
import threading
import time

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.models.two_link_arm import TwoLinkArm


@pytest.mark.slow
def test_two_processes_find_what_one_finds(dragged):
    case, _ = dragged
    effects = (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    options = npdr.DiscoveryOptions(effects=effects, max_effects=1)
    alone = npdr.discover(case.model, case.fit[[0]], search=options)
    with npdr.workers("loky", 2) as used:
        together = npdr.discover(case.model, case.fit[[0]], search=options)
    assert used.is_used
    kinds = [{k: v for k, v in d.to_dict().items() if k != "seconds"} for d in (alone, together)]
    assert kinds[0] == kinds[1]
    assert kinds[0]["effects"][0]["effect"] == "quadratic_drag"


def test_an_engine_with_threads_of_its_own_gets_no_further_processes():
    with npdr.workers("loky", 2):
        assert num_processes(Pendulum()) == 2
        assert num_processes(TwoLinkArm()) == 1


def test_a_function_that_cannot_be_pickled_runs_in_this_process():
    lock = threading.Lock()

    def doubled(x):
        with lock:
            return 2 * x

    assert list(side_by_side(doubled, [1, 2, 3], 2)) == [2, 4, 6]


@pytest.mark.slow
def test_replacing_a_process_whose_memory_has_grown_raises_no_warning(recwarn):
    def hoarding(x):
        # A half more than what the executor takes for a leak, after the second it waits to look;
        # kept where it outlives this function, which travels anew with every item.
        hoard = sys.modules["__main__"].__dict__.setdefault("hoard", [])
        hoard.append(torch.ones(450_000_000 // 4))
        time.sleep(1.1)
        return os.getpid()

    assert len(set(side_by_side(hoarding, range(6), 2))) > 2
    assert not [str(warning.message) for warning in recwarn]
