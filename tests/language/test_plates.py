"""Plates that do not fit their sites: one sentence that names the site, and says what to do."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import ModelError
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.rollouts import Rollouts

MASS = dist.Uniform(0.3, 1.7)


def simulated(mass, inputs):
    return npdr.simulate("trajectory", Pendulum(), {"mass": mass}, inputs, noise=0.1)


def another_size(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", dist.Uniform(torch.full((2,), 0.3), 1.7))
        simulated(mass, inputs)


def another_plates_size(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", MASS)
    with pyro.plate("pair", 2):
        simulated(mass, inputs)


def same_dimension(inputs):
    with pyro.plate("rigs", 3, dim=-1), pyro.plate("days", 2, dim=-1):
        simulated(pyro.sample("mass", MASS), inputs)


def outside(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", MASS)
    simulated(mass, inputs)


def in_the_wrong_dimension(inputs):
    with pyro.plate("rigs", 3, dim=-2):
        mass = pyro.sample("mass", MASS)
    with pyro.plate("days", 2, dim=-1):
        simulated(mass, inputs)


def without_a_plate(inputs):
    simulated(pyro.sample("mass", MASS.expand([3])), inputs)


def indexed_from_the_left(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", MASS)
    simulated(mass[0], inputs)


def component_from_the_left(inputs):
    mass = pyro.sample("mass", MASS.expand([3]).to_event(1))
    simulated(mass[0], inputs)


def subsampled_from_the_left(inputs):
    with pyro.plate("rigs", 3) as index:
        mass = pyro.sample("mass", MASS)
        simulated(mass[index], inputs)


def member_from_the_right(inputs):
    with pyro.plate("rigs", 3):
        mass = pyro.sample("mass", MASS)
    simulated(mass[..., 1:2], inputs)


def component_from_the_right(inputs):
    mass = pyro.sample("mass", MASS.expand([3]).to_event(1))
    simulated(mass[..., 1], inputs)


WRONG = {
    another_size: r"Site 'mass' has 2 values in dimension -1, where the plate 'rigs' has 3",
    another_plates_size: r"Site 'trajectory' has 3 values .* where the plate 'pair' has 2",
    same_dimension: r"The plates 'days' and 'rigs' both take dimension -1; .* dim=-2",
    outside: r"Site 'trajectory' takes parameters of shape \(3,\) outside of the plate",
    in_the_wrong_dimension: r"Site 'trajectory' takes parameters of shape \(3, 2\) outside",
    without_a_plate: r"Site 'mass' has the batch shape \(3,\) and no plate .* \.to_event\(1\)",
    indexed_from_the_left: r"Site 'trajectory' has 3 values .* index from the right",
    component_from_the_left: r"Site 'trajectory' has 3 values .* index from the right",
    subsampled_from_the_left: r"Site 'trajectory' has 3 values .* index from the right",
}


@pytest.fixture
def recording():
    time = 0.02 * np.arange(41)
    readings = np.stack([np.sin(3 * time), 3 * np.cos(3 * time)], -1)
    return Rollouts.from_arrays(
        readings=[readings], actions=[np.zeros((40, 1))], time_step=0.02,
        channel_names=("angle", "velocity"), action_names=("torque",),
    )  # fmt: skip


def infer(model, recording):
    quick = backend("snpe-c", transforms=1, hidden=(8,), epochs=1, members=1)
    return npdr.infer(
        model, recording, backend=quick, rounds=1, num_simulations=20,
        options=npdr.DataOptions(segment_length=20, initial_state="recorded"),
        progress=False,
    )  # fmt: skip


@pytest.mark.parametrize("model", WRONG, ids=lambda model: model.__name__)
def test_what_does_not_fit_its_plates_is_named(model, recording):
    with pytest.raises(ModelError, match=WRONG[model]) as caught:
        infer(model, recording)
    assert "\n" not in str(caught.value)  # without Pyro's table of shapes


@pytest.mark.parametrize("model", [member_from_the_right, component_from_the_right])
def test_what_the_sentence_asks_for_works(model, recording):
    assert infer(model, recording).sample(5)["mass"].shape == (5, 3)


def test_errors_of_the_program_itself_stay_what_they_are(recording):
    def broken(inputs):
        pyro.sample("mass", MASS)
        raise ValueError("no such thing")

    with pytest.raises(ValueError, match="no such thing"):
        infer(broken, recording)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["another_size", "indexed_from_the_left"])
def test_the_command_line_says_it_in_one_line(model, recording, tmp_path):
    recording.to_csv(tmp_path / "data.csv")
    found = subprocess.run(
        [
            sys.executable, "-m", "npdr_ppl.cli", "fit", f"{Path(__file__)}:{model}",
            "--data", tmp_path / "data.csv", "--out", tmp_path / "fit", "--segment-length", "20",
            "--simulations", "20", "--quiet",
        ],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert found.returncode == 2, found.stderr
    assert found.stderr.startswith("npdr: Site '") and len(found.stderr.splitlines()) == 1
