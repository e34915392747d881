"""How the true values of sensors move within a step."""

import math

import pytest
import torch

from npdr_ppl.engines.common.bends import Bends
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ClockSkew, SensorDelay, SensorLowPass
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


def test_velocities_behind_the_positions_have_the_same_bend():
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


def test_a_later_effect_filters_what_the_earlier_one_measured():
    delay, low_pass = SensorDelay("angle,velocity"), SensorLowPass("angle,velocity")
    free = {f"{delay.name}.delay": 0.025, f"{low_pass.name}.time_constant": 0.012}
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in free.items()}
    simulator = Pendulum(integrator="rk4").with_effects(delay, low_pass)

    def measured(parts):
        still = Inputs.single(
            torch.zeros(60 * parts, 1, dtype=torch.float64),
            torch.tensor([0.4, 0.0], dtype=torch.float64),
            action_names=("torque",),
            state_names=("angle", "velocity"),
            time_step=H / parts,
        )
        return simulator.simulate(given, still)[..., parts - 1 :: parts, :]

    error = measured(1) - measured(8)
    # Of a motion of 0.4 rad and 2 rad/s.
    assert error[..., 0].abs().max() < 2e-4
    assert error[..., 1].abs().max() < 1e-2


@pytest.mark.parametrize(
    "effect", [ClockSkew("clock"), SensorLowPass("angle")], ids=lambda e: e.id
)
def test_a_position_whose_rate_is_no_channel_begins_without_a_bend(effect):
    simulator = Pendulum(integrator="rk4")
    simulator.sensors = (Channel("angle", "rad"),)
    name, value = ("skew", 1e-3) if effect.id == "clock_skew" else ("time_constant", 0.012)
    moving = Inputs.single(
        torch.zeros(3, 1, dtype=torch.float64),
        torch.tensor([0.0, 2.0], dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=H,
    )
    given = {f"{effect.name}.{name}": torch.tensor(value, dtype=torch.float64)}
    alone = simulator.with_effects(effect).simulate(given, moving)
    both = Pendulum(integrator="rk4").with_effects(effect).simulate(given, moving)
    torch.testing.assert_close(alone[..., 0], both[..., 0], rtol=0.0, atol=1e-4)
