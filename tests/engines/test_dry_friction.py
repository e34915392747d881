"""Dry friction: stiction, stopping distance, the exact two-joint solution, gradients."""

import pytest
import torch

from npdr_ppl.engines.common.dry_friction import solve_dry_friction
from npdr_ppl.engines.common.integrators import INTEGRATORS
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    StribeckFriction,
)
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum

MAGNITUDE = "hinge.coulomb_friction.magnitude"


def torque(values, start=(0.0, 0.0), time_step=0.002):
    return Inputs.single(
        torch.as_tensor(values, dtype=torch.float64)[:, None],
        torch.tensor(start, dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=time_step,
    )


@pytest.mark.parametrize("name", INTEGRATORS)
def test_joint_at_rest_stays_until_the_torque_exceeds_the_friction(name):
    simulator = Pendulum(integrator=name).with_effects(CoulombFriction("hinge"))
    parameters = {MAGNITUDE: torch.tensor(0.5, dtype=torch.float64), "gravity": torch.tensor(0.0)}
    held = simulator.simulate(parameters, torque([0.49] * 1000))
    assert float(held.abs().max()) < 1e-12
    moved = simulator.simulate(parameters, torque([0.6] * 1000))[0, -1]
    # (τ − F)/(m l²/3) for two seconds.
    torch.testing.assert_close(moved[1], torch.tensor(0.3 * 2.0, dtype=torch.float64))


@pytest.mark.parametrize("name", INTEGRATORS)
def test_moving_joint_stops_where_it_should_and_does_not_chatter(name):
    simulator = Pendulum(integrator=name).with_effects(CoulombFriction("hinge"))
    parameters = {MAGNITUDE: torch.tensor(0.5, dtype=torch.float64), "gravity": torch.tensor(0.0)}
    out = simulator.simulate(parameters, torque([0.0] * 1000, start=(0.0, 1.0)))[0]
    # Deceleration 1.5 rad/s² from 1 rad/s.
    error = 2e-3 if INTEGRATORS[name].order == 1 else 1e-9
    assert float(out[-1, 0]) == pytest.approx(1.0 / 3.0, abs=error)
    assert float(out[-300:, 1].abs().max()) < 1e-9
    assert float(out[:, 1].min()) > -1e-3


@pytest.mark.parametrize(
    ("effect", "values", "error"),
    [
        (CoulombFriction("hinge"), {"magnitude": 0.3}, 1e-5),
        (AsymmetricCoulombFriction("hinge"), {"forward": 0.2, "backward": 0.4}, 1e-5),
        (StribeckFriction("hinge"), {"excess": 0.3, "speed": 0.3}, 2e-4),
    ],
)
def test_reversals_in_coarse_steps_are_those_of_fine_ones(effect, values, error):
    time = 0.02 * torch.arange(250)
    actions = torch.sin(2.6 * time) + torch.sin(6.9 * time)
    parameters = {
        f"{effect.name}.{name}": torch.tensor(value, dtype=torch.float64)
        for name, value in values.items()
    }

    def simulate(substeps):
        simulator = Pendulum(integrator="rk4", substeps=substeps).with_effects(effect)
        return simulator.simulate(parameters, torque(actions, time_step=0.02))[0]

    coarse, fine = simulate(1), simulate(8)
    assert int((fine[1:, 1] * fine[:-1, 1] < 0.0).sum()) >= 3
    # Friction that stops joints at a step's end is off by milliradians.
    assert float((coarse - fine)[:, 0].square().mean().sqrt()) < error
    assert float((coarse - fine)[:, 1].square().mean().sqrt()) < 5 * error


def test_both_joints_of_the_furuta_stick():
    effects = CoulombFriction("arm"), CoulombFriction("pole")
    simulator = Furuta().with_effects(*effects)
    inputs = Inputs.single(
        torch.full((500, 1), 0.5),
        torch.tensor([0.0, 0.05, 0.0, 0.0]),
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=0.002,
    ).to(dtype=torch.float64)
    # 0.5 V make 2.5e-3 N m, the pole's weight 7.6e-4 N m.
    friction = {
        "arm.coulomb_friction.magnitude": torch.tensor(3e-3, dtype=torch.float64),
        "pole.coulomb_friction.magnitude": torch.tensor(1e-3, dtype=torch.float64),
    }
    out = simulator.simulate(friction, inputs)
    torch.testing.assert_close(out[0, -1], inputs.initial_values[0], rtol=0, atol=1e-10)


def box_minimum(w, velocities, accelerations, bounds, step):
    """Minimises the friction's quadratic by projected gradient steps, many of them."""
    free = velocities / step + accelerations
    force = torch.zeros_like(free)
    rate = 1.0 / w.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    for _ in range(20_000):
        slope = (w @ force[..., None])[..., 0] + free
        force = (force - rate * slope).clamp(-bounds, bounds)
    return force


@pytest.mark.parametrize("num_joints", [1, 2, 3])
def test_solution_minimises_the_quadratic(num_joints):
    generator = torch.Generator().manual_seed(3)
    shape = (200, num_joints)
    root = torch.randn(200, num_joints, num_joints, generator=generator, dtype=torch.float64)
    w = root @ root.mT + 0.5 * torch.eye(num_joints, dtype=torch.float64)
    velocities = 0.05 * torch.randn(shape, generator=generator, dtype=torch.float64)
    accelerations = torch.randn(shape, generator=generator, dtype=torch.float64)
    bounds = torch.rand(shape, generator=generator, dtype=torch.float64)
    rows = tuple(tuple(row.unbind(-1)) for row in w.unbind(-2))
    forces = solve_dry_friction(
        tuple(bounds.unbind(-1)),
        tuple(velocities.unbind(-1)),
        tuple(accelerations.unbind(-1)),
        rows,
        0.1,
    )
    expected = box_minimum(w, velocities, accelerations, bounds, 0.1)
    atol = 1e-9 if num_joints < 3 else 1e-2  # Gauss-Seidel stops early
    torch.testing.assert_close(torch.stack(forces, -1), expected, rtol=0, atol=atol)


def test_probing_gives_the_declared_inverse_inertia():
    class Probed(Furuta):
        def inverse_inertia(self, positions, velocities, constants):
            return None

    effects = CoulombFriction("arm"), CoulombFriction("pole")
    friction = {
        "arm.coulomb_friction.magnitude": torch.tensor(1e-3, dtype=torch.float64),
        "pole.coulomb_friction.magnitude": torch.tensor(1e-4, dtype=torch.float64),
    }
    inputs = Inputs.single(
        torch.sin(torch.arange(500.0, dtype=torch.float64) / 20)[:, None],
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64),
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=0.002,
    )
    declared = Furuta().with_effects(*effects).simulate(friction, inputs)
    probed = Probed().with_effects(*effects).simulate(friction, inputs)
    torch.testing.assert_close(declared, probed, rtol=1e-6, atol=1e-8)


def test_gradient_of_the_friction_matches_a_finite_difference():
    simulator = Pendulum().with_effects(CoulombFriction("hinge"))
    inputs = torque(2.0 * torch.sin(torch.arange(200) / 30.0), time_step=0.02)

    def end(magnitude):
        return simulator.simulate({MAGNITUDE: magnitude}, inputs)[0, -1, 0]

    magnitude = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(end(magnitude), magnitude)
    step = 1e-6
    with torch.no_grad():
        difference = (end(magnitude + step) - end(magnitude - step)) / (2 * step)
    torch.testing.assert_close(gradient, difference, rtol=1e-4, atol=1e-6)
