"""Laws of force, tested by their values at pulses, have the results of their whole changes."""

from types import SimpleNamespace

import pytest
import torch

from npdr_ppl.discovery.screening.generic_laws import generic_laws, ripple_laws, wave_laws
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.permutation_tests import LargestStatistic
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import ForceChange, PulseChanges


@pytest.fixture(scope="module")
def projection(dragged):
    return Projection(dragged[1])


@pytest.fixture(scope="module")
def laws(projection):
    """The laws of force at the pendulum's hinge, and the responses to pulses."""
    found = responses(projection.hypothesis)
    ports = {name: PulseChanges(projection, change) for name, change in found.by_port.items()}
    sensors = projection.hypothesis.simulator.sensors
    every = generic_laws(found, ports, sensors) + ripple_laws(found, ports, sensors)
    every += wave_laws(found, ports)
    (change,) = found.by_port.values()
    return [law.change for law in every], change


def test_scores_are_those_of_the_changes(projection, laws):
    forces, change = laws
    for force in forces[::7]:
        few, whole = force.pulses.scores(force.values), projection.scores(change @ force.values)
        for one, other in (
            (few.by_segment, whole.by_segment),
            (few.information, whole.information),
            (few.total, whole.total),
        ):
            assert torch.allclose(one, other, rtol=1e-9, atol=1e-9 * float(other.abs().max()))


def test_p_values_are_those_of_the_changes(projection, laws):
    forces, change = laws
    few, whole = (
        LargestStatistic(projection, seed=0).p_values(groups)
        for groups in (forces, [change @ force.values for force in forces])
    )
    assert few == pytest.approx(whole, abs=1e-9)
    assert len(set(few)) > 10  # so the comparison is one of many values


@pytest.mark.parametrize(
    ("num_segments", "num_measurements"),
    [
        (30, 300),  # 30 x 5 columns fill a part of the space of measurements
        (30, 40),  # they fill it
        (61, 300),  # pairs of segments are joined, and one is left over
        (230, 400),  # three segments are joined
    ],
)
def test_any_number_of_measurements_has_the_p_values_of_the_changes(
    num_segments, num_measurements
):
    generator = torch.Generator().manual_seed(num_segments)

    def random(*shape):
        return torch.randn(num_segments, *shape, generator=generator).double()

    projection = Projection(
        SimpleNamespace(
            linearisation=SimpleNamespace(
                residual=random(num_measurements),
                by_parameters=random(num_measurements, 2),
                by_starts=random(num_measurements, 4),
            ),
            fit=SimpleNamespace(offsets=random(4)),
        )
    )
    pulses = random(num_measurements, 3)
    projection.residual = projection.residual + 0.2 * (pulses @ random(3, 1))[..., 0]
    values = [random(3, k) for k in (1, 1, 2, 3, 1, 2)]
    at_port = PulseChanges(projection, pulses)
    # Laws of force and other candidates are tested together.
    mixed = [ForceChange(at_port, v) if k % 2 else pulses @ v for k, v in enumerate(values)]
    few, whole = (
        LargestStatistic(projection, seed=0, draws=400).p_values(groups)
        for groups in (mixed, [pulses @ v for v in values])
    )
    assert few == pytest.approx(whole, abs=1e-9)
