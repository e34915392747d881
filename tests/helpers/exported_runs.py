"""A finished fit of an arm, with correlated draws, for tests of what leaves the package."""

import json

import numpy as np
import torch

from npdr_ppl.arviz_module import from_dict, to_netcdf
from npdr_ppl.discovery.discovery_result import DRAWS
from npdr_ppl.run_files import save_tensors

ARM = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <geom name="palm" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" ctrlrange="-3 3"/>
    <position name="servo" joint="elbow" kp="4" kv="0.2" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""

MODEL = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr

FIELDS = {
    "mass": "body hand mass_and_inertia",
    "damping": "joint shoulder damping",
    "kp": "actuator servo kp",
    "centre": "body hand centre z",
    "density": "option density",
    "grip": "geom palm friction sliding",
}
arm = npdr.MujocoSimulator("arm.xml", FIELDS, time_step=0.01)

def model(inputs):
    given = {name: pyro.sample(name, dist.Uniform(-1.0, 50.0)) for name in FIELDS}
    return npdr.simulate("x", arm, given, inputs)
"""

MEANS = {
    "mass": 0.4,
    "damping": 0.15,
    "kp": 5.0,
    "centre": -0.12,
    "density": 1.2,
    "grip": 0.8,
    "shoulder_torque.coulomb_friction.magnitude": 0.1,
    "gravity.tilt.roll": 0.02,
    "gravity.tilt.pitch": -0.01,
    "elbow_torque.stribeck_friction.excess": 0.3,
    "elbow_torque.stribeck_friction.speed": 0.5,
    "motor.input_delay.delay": 0.013,
    "elbow.encoder_bias.offset": 0.01,
}
"""Posterior means of a run with three effects that MuJoCo lacks."""

NUM_DRAWS = 400


def draws_of(means, seed=0):
    """Returns correlated draws by parameter, with standard deviations of 5 % of the means."""
    random = np.random.default_rng(seed)
    mixing = np.eye(len(means)) + 0.6 * np.eye(len(means), k=1)
    table = random.standard_normal((NUM_DRAWS, len(means))) @ mixing
    table /= table.std(axis=0)
    return {
        name: mean * (1.0 + 0.05 * table[:, i]) for i, (name, mean) in enumerate(means.items())
    }


def _records(draws):
    return {
        name: {
            "mean": float(values.mean()),
            "sd": float(values.std()),
            "hdi_94": np.quantile(values, [0.03, 0.97]).tolist(),
        }
        for name, values in draws.items()
    }


def write_robot(folder):
    """Writes the robot's file and the model's."""
    (folder / "arm.xml").write_text(ARM)
    (folder / "arm_model.py").write_text(MODEL)


def write_fit(folder, means):
    """Writes a finished fit; returns its draws by parameter."""
    folder.mkdir()
    draws = draws_of(means)
    chains = {name: values.reshape(4, -1) for name, values in draws.items()}
    to_netcdf(from_dict({"posterior": chains}), folder / "posterior.nc")
    found = {
        "backend": "snpe-c",
        "parameters": _records(draws),
        "finer_steps": 0,
        "units": {"mass": "kg", "kp": "N m/rad"},
        "preparation": {"segment_length": 20, "segment_seconds": 0.2},
    }
    (folder / "fit.json").write_text(json.dumps(found))
    return draws


def write_discovery(folder, means):
    """Writes a finished discovery with a revised model; returns its draws by parameter."""
    folder.mkdir()
    draws = draws_of(means)
    save_tensors(folder / DRAWS, {n: torch.from_numpy(v) for n, v in draws.items()})
    found = {
        "stage": "prove",
        "verdict": "ambiguous",
        "reason": "Two causes.",
        "parameters": _records(draws),
        "effects": [],
    }
    (folder / "discovery.json").write_text(json.dumps(found))
    return draws
