"""Integrators against scipy, their convergence orders, energy, and gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from npdr_ppl.engines.common.integrators import INTEGRATORS, integrator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum

NOMINAL = {parameter.name: parameter.nominal for parameter in Furuta.parameters}


def hold(voltage: float, start: list[float], num_steps: int, time_step: float) -> Inputs:
    """A constant voltage from a known state."""
    return Inputs.single(
        torch.full((num_steps, 1), voltage, dtype=torch.float64),
        torch.tensor(start, dtype=torch.float64),
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=time_step,
    )


def textbook_furuta(_, state, voltage):
    """The equations as published: mass matrix and right-hand side, solved numerically."""
    theta, alpha, theta_rate, alpha_rate = state
    p = NOMINAL
    arm_inertia = p["arm_mass"] * p["arm_length"] ** 2 / 12
    pole_inertia = p["pole_mass"] * p["pole_length"] ** 2 / 12
    c0 = arm_inertia + p["pole_mass"] * p["arm_length"] ** 2
    c1 = p["pole_mass"] * p["pole_length"] ** 2 / 4
    c2 = p["pole_mass"] * p["pole_length"] * p["arm_length"] / 2
    c3 = pole_inertia + c1
    c4 = p["pole_mass"] * p["pole_length"] * p["gravity"] / 2
    km, rm = p["motor_constant"], p["motor_resistance"]
    sin, cos, double = math.sin(alpha), math.cos(alpha), math.sin(2 * alpha)
    mass = np.array([[c0 + c1 * sin**2, c2 * cos], [c2 * cos, c3]])
    x = km * (voltage - km * theta_rate) / rm - p["arm_damping"] * theta_rate
    x -= c1 * double * theta_rate * alpha_rate - c2 * sin * alpha_rate**2
    y = -p["pole_damping"] * alpha_rate + c1 / 2 * double * theta_rate**2 - c4 * sin
    return [theta_rate, alpha_rate, *np.linalg.solve(mass, [x, y])]


START = [0.3, 1.1, -1.0, 2.0]


def reference(duration: float) -> np.ndarray:
    solution = solve_ivp(
        textbook_furuta, (0, duration), START, "DOP853", args=(1.5,), rtol=1e-13, atol=1e-14
    )
    return solution.y[:, -1]


@pytest.mark.parametrize("name", INTEGRATORS)
def test_error_falls_at_the_declared_order(name):
    duration = 0.2
    truth = torch.tensor(reference(duration))
    errors = []
    for num_steps in (200, 400, 800):
        inputs = hold(1.5, START, num_steps, duration / num_steps)
        end = Furuta(integrator=name).simulate({}, inputs)[0, -1]
        errors.append(float((end - truth).norm()))
    rates = [math.log2(a / b) for a, b in zip(errors, errors[1:], strict=False)]
    assert rates == pytest.approx([integrator(name).order] * 2, abs=0.15)


def test_substeps_equal_smaller_steps():
    coarse = Furuta(integrator="rk4", substeps=4).simulate({}, hold(1.0, START, 10, 0.008))
    fine = Furuta(integrator="rk4").simulate({}, hold(1.0, START, 40, 0.002))
    torch.testing.assert_close(coarse[:, -1], fine[:, -1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("name", "bound"), [("semi-implicit-euler", 0.05), ("rk4", 1e-5)])
def test_undamped_pendulum_keeps_its_energy(name, bound):
    inputs = Inputs.single(
        torch.zeros(2000, 1, dtype=torch.float64),
        torch.tensor([1.0, 0.0]),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.01,
    )
    angle, velocity = Pendulum(integrator=name).simulate({}, inputs)[0].unbind(-1)
    energy = velocity**2 / 6 - 9.81 / 2 * torch.cos(angle)
    start = -9.81 / 2 * math.cos(1.0)
    assert float((energy - start).abs().max()) < bound


def test_unknown_integrator_is_named():
    with pytest.raises(ModelError, match="no integrator 'rk5'"):
        Furuta(integrator="rk5")
