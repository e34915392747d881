"""Forces that act at some moments only."""

import dataclasses
import types

import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.moments import forces_at_moments
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import ALARM, MOMENT_TEST
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.preparation.data_options import DataOptions

SEED = 2000
"""No seed of the benchmark's, neither of its tuning nor of its reporting."""

HEARD = ALARM.moment_share * npdr.DiscoveryOptions().false_alarm_rate
"""From which on the alarm fires."""


def seen(condition, places=(), rig="pendulum", length="auto"):
    """Returns a fitted rig, and what pulses of force would change."""
    case = make_case(rig, condition, places, strength=1.0, seed=SEED)
    options = segment_options(case.fit, DataOptions(segment_length=length))
    fitted = fit_hypothesis(case.model, case.fit, options)
    return Projection(fitted), responses(fitted)


def moments(projection, found):
    (result,) = forces_at_moments(projection, found)
    return result


def test_bursts_of_force_stand_out():
    found = moments(*seen("outside", (("hinge", "torque_bursts"),)))
    assert found.name == "hinge: force at moments"
    assert found.p_value < HEARD
    assert (
        found.gain > MOMENT_TEST.num_directions * MOMENT_TEST.most_segments
    )  # what chance explains in as many segments


@pytest.mark.slow
def test_coloured_noise_and_outliers_resemble_no_force():
    assert moments(*seen("null")).p_value > HEARD
    assert moments(*seen("null_coloured")).p_value > HEARD
    assert moments(*seen("null_outliers")).p_value > HEARD


def test_a_kick_in_one_segment_is_heard_and_as_large_an_error_of_the_readings_is_not():
    projection, found = seen("null")
    kick = found.by_port["hinge"][7, :, 3]
    generator = torch.Generator().manual_seed(0)
    error = torch.randn(kick.shape, generator=generator, dtype=torch.float64)
    quiet = projection.residual.clone()

    def with_residual(change):
        projection.residual = quiet.clone()
        # What a kick does is large beside the smoother's error, which may explain most of it.
        projection.residual[7] += 60.0 * change / change.norm()
        return moments(projection, found)

    assert with_residual(kick).p_value < HEARD
    assert with_residual(error).p_value > HEARD


@pytest.mark.slow
def test_outliers_are_seldom_taken_for_forces():
    """Where all forces end, a part of an outlier lies along what they change."""
    projection, found = seen("null", rig="cart_pole")
    quiet = projection.residual.clone()
    generator = torch.Generator().manual_seed(0)

    def uniform():
        return torch.rand(quiet.shape, generator=generator, dtype=torch.float64)

    def least_p_value():
        projection.residual = quiet + 20.0 * (2.0 * uniform() - 1.0) * (uniform() < 0.02)
        return min(moment.p_value for moment in forces_at_moments(projection, found))

    values = [least_p_value() for _ in range(50)]
    assert sum(p < 0.05 for p in values) <= 5  # of which 2.5 are to be expected
    assert min(values) > HEARD


@pytest.mark.slow
@pytest.mark.parametrize("length", [46, 38, 33, 26])
def test_a_shorter_last_segment_is_no_sign_of_a_force(length):
    projection, found = seen("null", length=length)
    last = projection.num_measured.min()
    assert last == 2 * (500 % length) < 2 * length  # an angle and a velocity per step
    assert moments(projection, found).p_value > 0.05


def test_segments_of_few_readings_say_nothing():
    projection, found = seen("null")
    few = MOMENT_TEST.num_directions + 1
    short = types.SimpleNamespace(
        residual=projection.residual[:, :few],
        num_measured=torch.full((len(projection.residual),), few),
        whitened=lambda x: x,
    )
    ports = {port: change[:, :few] for port, change in found.by_port.items()}
    assert forces_at_moments(short, dataclasses.replace(found, by_port=ports)) == []
