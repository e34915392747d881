import gc
import math
import os
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import settings

import npdr_ppl as npdr
from npdr_ppl.engines.common import compilation
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.prior import Prior
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior import estimator_check
from npdr_ppl.preparation import importance_sampling
from npdr_ppl.rollouts import Rollouts

NOISE = {"angle": 0.05, "velocity": 0.2}

# A worker per core: torch's own threads would only get in each other's way.
torch.set_num_threads(int(os.environ.get("NPDR_NUM_THREADS", "1")))

# Nor would processes that a command starts on its own, one per core.
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")

# Nor do the tests see effects that their user has added.
os.environ["NPDR_EFFECTS"] = os.path.join(os.path.dirname(__file__), "no_added_effects")

# The same examples every time, so that a run says something about the change under test;
# NPDR_EXPLORE=1 looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("explore", max_examples=2_000)
settings.load_profile("explore" if os.environ.get("NPDR_EXPLORE") else "repeatable")


@pytest.fixture(scope="module", autouse=True)
def spared_collections():
    """Takes what is there to stay, libraries and kernels, out of garbage collections.

    A process that has run hundreds of tests holds millions of objects, and code that frees
    memory on purpose would look through all of them every time.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def short_kernels(monkeypatch):
    """Compiles loops of two time steps, however long they are to run."""
    monkeypatch.setattr(compilation, "_STEPS_PER_CALL", (2,))
    compilation._compile.cache_clear()
    yield
    compilation._compile.cache_clear()


@pytest.fixture
def quick():
    """A backend that trains in a second."""
    return backend("snpe-c", transforms=2, hidden=(32,), epochs=15, members=2)


@pytest.fixture
def few_draws(monkeypatch):
    """Gives the check of a posterior too few draws to agree with the simulator, and no others."""
    monkeypatch.setattr(importance_sampling, "surrogate_draws", lambda *_, **__: None)
    few = replace(
        importance_sampling.IMPORTANCE_SAMPLING,
        most_iterations=1, draws_per_iteration=8, draws_of_given=8, num_walkers=4,
    )  # fmt: skip
    monkeypatch.setattr(importance_sampling, "IMPORTANCE_SAMPLING", few)
    fewer = replace(estimator_check.ESTIMATOR_CHECK, num_draws=16)
    monkeypatch.setattr(estimator_check, "ESTIMATOR_CHECK", fewer)


@pytest.fixture
def linear():
    """theta ~ N(0, 1), x | theta ~ N(theta, 0.5²) in two dimensions, and an observation."""

    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        npdr.simulate("x", lambda theta: theta, {"theta": theta}, noise=0.5)

    return model, torch.tensor([0.8, -0.4])


def _noisy_pendulum(inputs):
    return pendulum(inputs, noise=NOISE)


@pytest.fixture
def noisy_pendulum():
    """The zoo's pendulum with noisy sensors."""
    return _noisy_pendulum


@pytest.fixture
def recording():
    """Two noisy rollouts of the nominal pendulum under a sinusoidal torque."""
    torque = 4.5 * torch.sin(2 * math.pi * 0.02 * torch.arange(100, dtype=torch.float64))[:, None]
    inputs = Inputs.single(
        torque,
        torch.zeros(2),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.02,
    )
    nominal = {"mass": torch.ones(2), "length": torch.ones(2)}
    torch.manual_seed(0)
    trajectories = Prior(_noisy_pendulum, (inputs,)).execute_at(nominal)["trajectory"][:, 0]
    start = torch.zeros(1, 2, dtype=torch.float64)
    return Rollouts.from_arrays(
        readings=[torch.cat([start, t]).numpy() for t in trajectories],
        actions=[torque.numpy()] * 2,
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    )
