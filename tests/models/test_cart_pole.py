"""The cart-pole's equations against its energy, and what its model samples."""

import math

import pyro
import torch

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.cart_pole import CartPole, cart_pole
from npdr_ppl.models.effects import Tilt


def energy(parameters, gravity, positions, velocities):
    """Kinetic plus potential energy of a cart and a uniform rod, from the rod's centre."""
    p = parameters
    (x, angle), (speed, rate) = positions, velocities
    half = 0.5 * p["pole_length"]
    centre = torch.stack((x + half * angle.sin(), -half * angle.cos()))
    velocity = torch.stack((speed + half * rate * angle.cos(), half * rate * angle.sin()))
    spin = p["pole_mass"] * p["pole_length"] ** 2 / 12.0
    kinetic = 0.5 * (
        p["cart_mass"] * speed**2 + p["pole_mass"] * velocity.square().sum() + spin * rate**2
    )
    weight = p["pole_mass"] * (gravity * centre).sum() + p["cart_mass"] * gravity[0] * x
    return kinetic - weight


def test_power_in_is_energy_gained():
    """dE/dt = F ẋ − c ẋ² − d θ̇², level and tilted, at random states."""
    generator = torch.Generator().manual_seed(0)
    simulator = CartPole().with_effects(Tilt("gravity"))
    p = simulator.nominal()
    for pitch in (0.0, 0.3):
        given = {"gravity.tilt.pitch": torch.tensor([pitch], dtype=torch.float64)}
        domain = simulator.complete(given, torch.float64, torch.device("cpu"))
        tables, _ = simulator.tables(domain, torch.Size((1,)), 0.01)
        gravity = p["gravity"] * torch.tensor([-math.sin(pitch), -math.cos(pitch)]).double()
        for _ in range(5):
            q, v = torch.randn(2, 2, generator=generator, dtype=torch.float64)
            force = torch.randn(1, generator=generator, dtype=torch.float64)
            q.requires_grad_()
            v.requires_grad_()
            with torch.no_grad():
                a = simulator.accelerations(
                    tuple(q[:, None]), tuple(v[:, None]), (force,), (0.0, 0.0), tables.constants
                )
            slope_q, slope_v = torch.autograd.grad(energy(p, gravity, q, v), (q, v))
            gained = (slope_q * v).sum() + (slope_v * torch.cat(a)).sum()
            power = force[0] * v[0] - p["cart_damping"] * v[0] ** 2 - p["pole_damping"] * v[1] ** 2
            torch.testing.assert_close(gained.detach(), power.detach())


def test_inverse_inertia_is_the_effect_of_unit_forces():
    simulator, p = CartPole(), CartPole().nominal()
    constants = simulator.constants(p, simulator.environment(p))
    q = tuple(torch.tensor([[0.3], [1.1]], dtype=torch.float64))
    v = tuple(torch.tensor([[0.5], [-2.0]], dtype=torch.float64))
    rest = simulator.accelerations(q, v, v[:1], (0.0, 0.0), constants)
    rows = simulator.inverse_inertia(q, v, constants)
    for joint, pushed in enumerate(((1.0, 0.0), (0.0, 1.0))):
        moved = simulator.accelerations(q, v, v[:1], pushed, constants)
        for row, before, after in zip(rows, rest, moved, strict=True):
            torch.testing.assert_close(after - before, row[joint].expand(1))


def test_model_samples_masses_length_and_dampings():
    inputs = Inputs.single(
        torch.ones(20, 1),
        torch.zeros(4),
        action_names=("force",),
        state_names=tuple(state.name for state in CartPole.states),
        time_step=0.01,
    )
    with pyro.poutine.trace() as tracer, pyro.plate("draws", 3), torch.no_grad():
        trajectory = cart_pole(inputs)
    assert trajectory.shape == (3, 1, 20, 4)
    sampled = {p.name for p in CartPole.parameters} & set(tracer.trace.nodes)
    assert sampled == {p.name for p in CartPole.parameters} - {"gravity"}
