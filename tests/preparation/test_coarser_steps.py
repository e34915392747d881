"""Fits of a simulator with fine steps that simulate in coarser ones."""

import mujoco
import pyro
import pyro.distributions as dist
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.ode import simulator as simulator_of_equations
from npdr_ppl.engines.ode.simulator import ODESimulator
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.language.sites import simulate
from npdr_ppl.models.effects import CoulombFriction
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_fit import fit_segments
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging

PENDULUM = """<mujoco><option timestep="0.02" integrator="Euler"/><worldbody><body name="bob">
<joint name="hinge" axis="0 -1 0"/><inertial pos="0 0 -0.45" mass="1"
diaginertia=".07425 .07425 .01"/></body></worldbody><actuator>
<motor name="torque" joint="hinge" ctrlrange="-4 4"/></actuator></mujoco>"""

SIMULATOR = MujocoSimulator(
    mujoco.MjModel.from_xml_string(PENDULUM),
    {"mass": "body bob mass", "damping": "joint hinge damping"},
    states={"angle": "hinge", "velocity": "hinge_velocity"},
)


def model(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.5, 1.7))
    damping = pyro.sample("damping", dist.HalfNormal(0.1))
    return simulate("motion", SIMULATOR, {"mass": mass, "damping": damping}, inputs)


EQUATIONS = Pendulum(integrator="rk4")


def equations(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.5, 1.7))
    damping = pyro.sample("damping", dist.HalfNormal(0.1))
    return simulate("motion", EQUATIONS, {"mass": mass, "damping": damping}, inputs)


def stiff(inputs):
    """Damped by 2.3 per step; midpoint steps are unstable from 2 on, of order four from 2.8 on."""
    mass = pyro.sample("mass", dist.Uniform(0.5, 1.7))
    damping = pyro.sample("damping", dist.Uniform(38.0, 39.0))
    given = {"mass": 1.0 + 0.0 * mass, "damping": damping}
    return simulate("motion", EQUATIONS, given, inputs)


PROGRAMS = {"mujoco": with_finer_steps(model), "equations": equations}


@pytest.fixture(autouse=True)
def whatever_the_number_of_simulations(monkeypatch):
    monkeypatch.setattr(simulator_of_equations, "COARSER_SIMULATIONS", 0)


@pytest.fixture(scope="module", params=PROGRAMS)
def segments(request):
    recording = swinging(rollouts=2, steps=120)
    return SegmentModel(PROGRAMS[request.param], recording, DataOptions(None, 40))


def in_fine_steps_only(monkeypatch):
    for simulator in (MujocoSimulator, ODESimulator):
        monkeypatch.setattr(simulator, "with_coarser_steps", lambda self, *_, **__: None)


def test_finer_steps_lead_back_to_the_files_own():
    friction = CoulombFriction("hinge")
    finer = SIMULATOR.with_finer_steps().with_finer_steps().with_effects(friction)
    coarser = finer.with_coarser_steps()
    assert coarser.effects == finer.effects
    assert coarser.num_substeps(0.02) == 1
    assert coarser.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert coarser.with_coarser_steps() is None


def test_several_steps_per_sample_become_half_as_many():
    assert SIMULATOR.with_coarser_steps(time_step=0.06) is None
    friction = CoulombFriction("hinge")
    coarser = SIMULATOR.with_effects(friction).with_coarser_steps(time_step=0.1)
    assert coarser.effects == (friction,)
    assert (SIMULATOR.num_substeps(0.1), coarser.num_substeps(0.1)) == (5, 3)
    own, half = (each.prepared(0.03, set()) for each in (SIMULATOR, coarser))
    assert own.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert half.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert coarser.with_coarser_steps(time_step=0.1) is None
    # Refined steps lead back to the file's own only.
    again = SIMULATOR.with_finer_steps().with_coarser_steps(time_step=0.1)
    assert again.num_substeps(0.1) == 5 and again.with_coarser_steps(time_step=0.1) is None


def test_steps_of_order_four_lead_to_midpoint_steps_where_these_save_time(monkeypatch):
    friction = CoulombFriction("hinge")
    coarser = EQUATIONS.with_effects(friction).with_coarser_steps()
    assert (coarser.integrator.name, coarser.effects) == ("midpoint", (friction,))
    assert coarser.with_coarser_steps() is None
    monkeypatch.setattr(simulator_of_equations, "COARSER_SIMULATIONS", 100)
    assert EQUATIONS.with_coarser_steps(99) is None
    assert EQUATIONS.with_coarser_steps(100) is not None


def test_unstable_coarser_steps_are_not_used(segments):
    z = torch.zeros(2, dtype=torch.float64)
    overdamped = segments.with_model(stiff)
    offsets = overdamped.no_offsets
    assert bool(overdamped.scale_of(z, offsets).isfinite().all())
    assert overdamped.in_coarser_steps(z, offsets) is overdamped


def test_residuals_at_the_point_are_those_of_the_fine_steps(segments, monkeypatch):
    z = torch.tensor([0.2, -0.5], dtype=torch.float64)
    offsets = 0.3 * torch.ones_like(segments.no_offsets)
    scale = torch.full((2,), 1e-2, dtype=torch.float64)
    near = segments.in_coarser_steps(z, offsets)
    here = segments.residuals(z[None], offsets[None], scale)
    torch.testing.assert_close(near.residuals(z[None], offsets[None], scale), here)
    assert near.simulator.with_coarser_steps() is None
    in_fine_steps_only(monkeypatch)
    assert segments.in_coarser_steps(z, offsets) is segments


def test_a_fit_in_coarser_steps_ends_where_one_in_fine_steps_does(segments, monkeypatch):
    start = torch.tensor([0.5, 0.5], dtype=torch.float64)
    found = fit_segments(segments, start)
    in_fine_steps_only(monkeypatch)
    exact = fit_segments(segments, start)
    now = segments.linearise(exact.z, exact.offsets, exact.scale)
    likelihood = SegmentLikelihood(segments, exact, now, 1.0, is_noise_declared=False)
    deviation = likelihood.information().inverse().diagonal().sqrt()
    assert ((found.z - exact.z).abs() < 0.1 * deviation).all()
    torch.testing.assert_close(found.scale, exact.scale, rtol=1e-3, atol=0.0)


def test_a_likelihood_in_coarser_steps_is_that_of_the_fine_ones(segments, monkeypatch):
    fit = fit_segments(segments, torch.zeros(2, dtype=torch.float64))
    now = segments.linearise(fit.z, fit.offsets, fit.scale)

    def drops():
        likelihood = SegmentLikelihood(segments, fit, now, 1.0, is_noise_declared=False)
        deviation = (likelihood.information() + torch.eye(2)).inverse().diagonal().sqrt()
        away = deviation * torch.tensor([[-2.0, 0.0], [0.0, 2.0]])
        return likelihood.log_prob(fit.z + away) - likelihood.log_prob(fit.z[None])

    near = drops()
    in_fine_steps_only(monkeypatch)
    torch.testing.assert_close(near, drops(), rtol=0.05, atol=0.0)
