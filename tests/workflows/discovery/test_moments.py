"""Forces that act at some moments only."""

from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.workflows.discovery.alarm import MOMENT_SHARE
from npdr_ppl.workflows.discovery.hypothesis import fit_hypothesis
from npdr_ppl.workflows.discovery.latent_force import responses
from npdr_ppl.workflows.discovery.moments import MOST, SHAPES, forces_at_moments
from npdr_ppl.workflows.discovery.projection import Projection

SEED = 2000
"""No seed of the benchmark's, neither of its tuning nor of its reporting."""

HEARD = MOMENT_SHARE * npdr.DiscoveryOptions().false_alarm_rate
"""From which on the alarm fires."""


def moments(condition, places, strength=1.0):
    case = make_case("pendulum", condition, places, strength=strength, seed=SEED)
    binding = npdr.DiscoveryOptions().binding(case.fit)
    fitted = fit_hypothesis(case.model, case.fit, binding)
    (found,) = forces_at_moments(Projection(fitted), responses(fitted))
    return found


def test_bursts_of_force_stand_out():
    found = moments("outside", (("hinge", "torque_bursts"),))
    assert found.name == "hinge: force at moments"
    assert found.p_value < HEARD
    assert found.gain > SHAPES * MOST  # what chance explains in as many segments


def test_coloured_noise_and_outliers_resemble_no_force():
    assert moments("null", ()).p_value > HEARD
    assert moments("null_coloured", ()).p_value > HEARD
    assert moments("null_outliers", ()).p_value > HEARD
