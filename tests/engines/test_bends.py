"""How the true values of sensors move within a step."""

import math

import pytest
import torch

from npdr_ppl.engines.common.bends import Bends
from npdr_ppl.language.channels import Channel
from npdr_ppl.models.pendulum import Pendulum

H, TIME = 0.02, 0.7


def values(*times):
    """Angle and velocity of a motion sin 3t at some times."""
    return [
        tuple(
            torch.tensor([x], dtype=torch.float64) for x in (math.sin(3 * t), 3 * math.cos(3 * t))
        )
        for t in times
    ]


def within(bends, column, share):
    """Returns the value at a share of a step and the error of a straight line."""
    present, last, previous = values(TIME, TIME - H, TIME - 2 * H)
    line = float((1 - share) * last[column] + share * present[column])
    bend = float(bends.within(column, present, last, previous))
    (true,) = values(TIME - (1 - share) * H)
    return line + share * (1 - share) * bend - float(true[column]), line - float(true[column])


@pytest.mark.parametrize("column", [0, 1])
def test_values_between_steps_are_far_closer_than_a_straight_line(column):
    bends = Bends(Pendulum(), H, 0.0)
    for share in (0.2, 0.5, 0.9):
        error, of_line = within(bends, column, share)
        assert abs(error) < 0.02 * abs(of_line)


def test_velocities_ahead_of_the_positions_have_the_same_bend():
    # Semi-implicit Euler steps under a constant acceleration: x₁ = x₀ + h v₁.
    present, last = (
        tuple(torch.tensor([x], dtype=torch.float64) for x in pair)
        for pair in ((0.02 * 1.4, 1.4), (0.0, 1.0))
    )
    assert float(Bends(Pendulum(), H, 0.5).within(1, present, last, last)) == pytest.approx(0.0)
    assert abs(float(Bends(Pendulum(), H, 0.0).within(1, present, last, last))) > 0.1


def test_without_their_integrator_velocities_move_on_lines():
    present, last = values(TIME, TIME - H)
    assert float(Bends(Pendulum(), H, None).within(1, present, last, last)) == 0.0


def test_a_position_without_its_rate_follows_a_parabola():
    simulator = Pendulum()
    simulator.sensors = (Channel("angle", "rad"),)
    x = [(torch.tensor([float(k * k)]),) for k in (5, 4, 3)]
    assert float(Bends(simulator, H, 0.0).within(0, *x)) == -1.0


def test_bends_before_a_start_are_those_of_a_constant_acceleration():
    rate = torch.tensor([3.0], dtype=torch.float64)
    steps = (1, 2, 3)
    changes = {
        0: tuple(0.5 * 2.0 * (k * H) ** 2 - k * H * rate for k in steps),
        1: tuple(torch.full_like(rate, -2.0 * k * H) for k in steps),
    }
    bends = Bends(Pendulum(), H, 0.0)
    for bend in bends.before(0, changes):
        assert float(bend) == pytest.approx(-0.5 * 2.0 * H * H)
    assert all(float(bend) == 0.0 for bend in bends.before(1, changes))
    assert len(bends.before(0, changes)) == 3
