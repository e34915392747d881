"""The Furuta pendulum against the paper's recordings."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import Tilt
from npdr_ppl.models.furuta import Furuta, furuta, furuta_paper

RECORDINGS = Path(__file__).parents[3] / "shared/data/quanser_qube/swing_up_500hz_5s.csv"
NAMES = tuple(state.name for state in Furuta.states)
STEPS, SEGMENT = 2500, 200


def segments(states: torch.Tensor, voltage: torch.Tensor) -> Inputs:
    starts = torch.arange(0, STEPS, SEGMENT)
    padded = torch.zeros(len(starts) * SEGMENT, dtype=states.dtype)
    padded[:STEPS] = voltage
    mask = torch.arange(len(padded)) < STEPS
    return Inputs(
        actions=padded.reshape(-1, SEGMENT, 1),
        action_names=("voltage",),
        initial_readings=states[starts],
        initial_values=states[starts],
        initial_rates=None,
        channel_names=NAMES,
        past_actions=padded.new_zeros(len(starts), 0, 1),
        time_step=0.002,
        mask=mask.reshape(-1, SEGMENT),
        rollout=torch.zeros(len(starts), dtype=torch.long),
        start=starts,
    )


@pytest.mark.skipif(not RECORDINGS.exists(), reason=f"the recordings {RECORDINGS} are absent")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("dampings", "expected"), [((5e-6, 1e-6), 0.3844), ((0.0015, 0.0005), 0.2730)]
)
def test_nominal_error_on_the_recordings_is_the_published_one(dampings, expected, dtype):
    parameters = {
        "arm_damping": torch.tensor(dampings[0], dtype=dtype),
        "pole_damping": torch.tensor(dampings[1], dtype=dtype),
    }
    errors = []
    for _, rollout in pd.read_csv(RECORDINGS).groupby("rollout"):
        states = torch.tensor(rollout[list(NAMES)].to_numpy(), dtype=dtype)
        voltage = torch.tensor(rollout["voltage"].to_numpy()[:STEPS], dtype=dtype)
        inputs = segments(states, voltage)
        readings = Furuta().simulate(parameters, inputs)
        # Series of the states at t = 0 ... 2499: each segment's start, then its readings.
        series = torch.cat((inputs.initial_values[:, None], readings[:, :-1]), dim=1)
        error = (series.flatten(0, 1)[:STEPS] - states[:STEPS]) / states.abs().amax(0)
        errors.append(float(error.square().mean(0).sqrt().mean()))
    assert sum(errors) / len(errors) == pytest.approx(expected, abs=1e-4)


def test_tilted_gravity_is_the_gradient_of_the_potential():
    """Force balance at rest: the accelerations times the mass matrix are −∂U/∂q."""
    tilt = {"gravity.tilt.roll": 0.3, "gravity.tilt.pitch": -0.2}
    given = {name: torch.tensor([value], dtype=torch.float64) for name, value in tilt.items()}
    simulator = Furuta().with_effects(Tilt("gravity"))
    domain = simulator.complete(given, torch.float64, torch.device("cpu"))
    tables, _ = simulator.tables(domain, torch.Size((1,)), 0.002)
    q = torch.tensor([0.7, 1.9], dtype=torch.float64, requires_grad=True)
    theta, alpha = q
    p = simulator.nominal()
    radial = torch.stack((theta.cos(), theta.sin(), torch.zeros_like(theta)))
    across = torch.stack((-theta.sin(), theta.cos(), torch.zeros_like(theta)))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    centre = p["arm_length"] * radial + 0.5 * p["pole_length"] * (
        alpha.sin() * across - alpha.cos() * up
    )
    gravity = torch.stack(
        Tilt("gravity").environment(
            (0.0, 0.0, -p["gravity"]),
            {"roll": given["gravity.tilt.roll"][0], "pitch": given["gravity.tilt.pitch"][0]},
        )
    )
    potential = -p["pole_mass"] * (gravity * centre).sum()
    (slope,) = torch.autograd.grad(potential, q)
    with torch.no_grad():
        positions = tuple(q.detach()[:, None])
        rest = (torch.zeros(1, dtype=torch.float64),) * 2
        a = simulator.accelerations(positions, rest, rest[:1], (0.0, 0.0), tables.constants)
        w = simulator.inverse_inertia(positions, rest, tables.constants)
        inverse = torch.stack([torch.cat(row) for row in w])
        force = torch.linalg.solve(inverse, torch.cat(a))
    torch.testing.assert_close(force, -slope)


@pytest.mark.parametrize(("model", "damping"), [(furuta, 1e-3), (furuta_paper, 2.5e-5)])
def test_model_samples_every_parameter_and_a_trajectory(model, damping):
    import pyro

    inputs = segments(torch.zeros(STEPS + 1, 4), torch.ones(STEPS))
    with pyro.poutine.trace() as tracer, pyro.plate("draws", 3), torch.no_grad():
        trajectory = model(inputs)
    sites = tracer.trace.nodes
    assert trajectory.shape == (3, 13, SEGMENT, 4)
    assert trajectory.isfinite().all()
    assert {p.name for p in Furuta.parameters} < set(sites)
    assert sites["arm_damping"]["fn"].support.upper_bound == pytest.approx(damping)
