"""Small runs of every kind, made once."""

import json
import math

import numpy as np
import pytest
import torch

from npdr_ppl.inference.registry import backend
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.comparison.compare import compare
from npdr_ppl.posterior.fit import fit
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts
from tests.helpers.small_loop import SMALL_DATA, HandmadePendulum, small_options, small_task

OPTIONS = DataOptions("all/10", 25, "recorded")
PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010806000000 1f15c4890000000d49444154789c63"
    "6460f8ff1f00030301ff5b7c2f9a0000000049454e44ae426082".replace(" ", "")
)


@pytest.fixture(scope="session")
def recording():
    """Two rollouts of a pendulum that is not quite the model's."""
    rng = np.random.default_rng(0)
    torque = 2.0 * np.sin(2 * math.pi * 0.02 * np.arange(100))[:, None]
    readings = []
    for start in (0.0, 0.3):
        state, rows = np.array([start, 0.0]), []
        for step in range(101):
            rows.append(state + rng.normal(0, [0.005, 0.02]))
            held = torque[min(step, 99), 0]
            for _ in range(10):
                rate = (held - 0.9 * 9.81 * 0.55 * math.sin(state[0])) / (0.9 * 1.1**2 / 3)
                state = state + 0.002 * np.array([state[1] + 0.002 * rate, rate])
        readings.append(np.array(rows))
    return Rollouts.from_arrays(
        readings=readings,
        actions=[torque] * 2,
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    )


@pytest.fixture(scope="session")
def runs(tmp_path_factory, recording):
    """Folders by command."""
    folder = tmp_path_factory.mktemp("runs")
    torch.manual_seed(0)
    quick = backend("snpe-c", transforms=1, hidden=(16,), epochs=3, members=2)
    small = {"rounds": 1, "num_simulations": 100, "options": OPTIONS, "progress": False}
    fit(pendulum, recording[[0]], recording[[1]], out=folder / "fit", backend=quick, **small)
    compare(
        pendulum,
        recording[[0]],
        recording[[1]],
        out=folder / "compare",
        backends={"snpe-c": quick, "<b>abc</b>": backend("abc")},
        **small,
    )
    train(
        pendulum,
        HandmadePendulum(),
        small_task(),
        options=SMALL_DATA,
        loop=small_options(),
        out=folder / "train",
        seed=0,
        progress=False,
    )
    write_discovery(folder / "discover")
    return {path.name: path for path in sorted(folder.iterdir())}


def write_discovery(folder):
    """Writes what a search for the missing effect leaves behind, by the documented names."""
    folder.mkdir()
    friction = {
        "effect": "coulomb_friction",
        "port": "hinge",
        "probability": 0.93,
        "equivalent_to": ["stribeck_friction"],
        "parameters": {
            "magnitude": {"mean": 0.4, "sd": 0.05, "hdi_94": [0.3, 0.5], "unit": "N m"}
        },
    }
    discovery = {
        "alarm": {"p_value": 0.002, "fired": True},
        "where": [
            {"rollout": 0, "time_span": [0.2, 0.6], "channel": "velocity",
             "region": "slow, reversing", "z": 7.2},
        ],
        "verdict": "named",
        "effects": [friction],
        "ranking": [friction, {"effect": "input_delay", "port": "torque", "probability": 0.04}],
        "gap": {"rmse": {"before": 0.2, "after": 0.06, "noise_floor": 0.05, "closed": 0.93}},
        "next_experiment": {"amplitude": 1.5, "frequency": 0.5},
        "model": {"source": "def pendulum(inputs):\n    mass = 1.0\n    return mass\n"},
    }  # fmt: skip
    (folder / "discovery.json").write_text(json.dumps(discovery))
    (folder / "revised_model.py").write_text(
        "def pendulum(inputs):\n    mass = 1.0\n    friction = '<script>'\n    return mass\n"
    )
    (folder / "where.png").write_bytes(PIXEL)
