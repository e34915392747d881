"""Time and memory of fit and screening against the number of joints and of candidates.

    python benchmarks/joint_costs.py --out joint_costs.json
    python benchmarks/joint_costs.py --joints 2,4 --seconds 5

A chain of links moves in a vertical plane. Every joint has a position servo and an encoder. The
recording has two rollouts of ten seconds at 500 Hz under sums of sines, made by the same engine in
ten times as many steps, with dry friction in the last joint. Damping and armature of every joint
are parameters.

For each number of joints, the original model is fitted, and the whole catalogue is screened once.
The screening is repeated with every fourth candidate, which shows how its time grows with their
number. Every row is measured in a process of its own on one thread: processor seconds, and the
peak resident memory, that of the imported libraries included.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyro
import pyro.distributions as dist
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.look import look
from npdr_ppl.models.effects import candidate_effects

JOINTS = (1, 2, 4, 6, 7, 12)

STEP, SUBSTEPS = 0.002, 10

NOISE = 2e-4
"""Standard deviation of the positions, rad."""

FRICTION = 0.02
"""Of the last joint, as a share of the greatest weight that it carries."""

REACH = 1.0
"""Length of the chain, m; its mass is 4 kg."""


def chain(number: int, step: float = STEP, friction: float = 0.0) -> mujoco.MjModel:
    """Returns a chain of links whose lengths and masses add up to the same for any number."""
    length, mass = REACH / number, 4.0 / number
    inner = actuators = ""
    for k in reversed(range(number)):
        load = mass * (number - k) * 9.81 * length * (number - k) / 2.0
        loss = friction * load if k == number - 1 else 0.0
        inner = f"""<body name="link_{k}" pos="{length if k else 0.0} 0 0">
        <joint name="joint_{k}" axis="0 1 0" damping="{0.1 * load}" armature="{0.02 * load}"
        frictionloss="{loss}" range="-150 150"/>
        <geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.02" mass="{mass}"/>
        {inner}</body>"""
        actuators += (
            f'<position name="servo_{k}" joint="joint_{k}" kp="{20.0 * load}" kv="{load}"/>'
        )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="degree"/><option timestep="{step}" integrator="implicitfast">
        <flag contact="disable"/></option><worldbody>{inner}</worldbody>
        <actuator>{actuators}</actuator></mujoco>"""
    )


def recorded(number: int, seconds: float) -> npdr.Rollouts:
    """Returns a recording of the chain."""
    model, rng = chain(number, STEP / SUBSTEPS, FRICTION), np.random.default_rng(number)
    readings, commands = [], []
    time_ = STEP * np.arange(round(seconds / STEP))
    for _ in range(2):
        data = mujoco.MjData(model)
        goals = sum(
            0.2 * np.sin(2.0 * np.pi * rng.uniform(0.1, 1.0, number) * time_[:, None])
            for _ in range(3)
        )
        rows = [np.array(data.qpos)]
        for goal in goals:
            data.ctrl[:] = goal
            for _ in range(SUBSTEPS):
                mujoco.mj_step(model, data)
            rows.append(np.array(data.qpos))
        readings.append(np.array(rows) + NOISE * rng.standard_normal((len(rows), number)))
        commands.append(goals)
    return npdr.Rollouts.from_arrays(
        readings=readings,
        actions=commands,
        channel_names=[f"joint_{k}" for k in range(number)],
        action_names=[f"servo_{k}" for k in range(number)],
        time_step=STEP,
    )


def measured(number: int, seconds: float) -> dict[str, Any]:
    """Returns the figures of a chain."""
    joints = [f"joint_{k}" for k in range(number)]
    addresses = {
        f"{quantity}_{name}": f"joint {name} {quantity}"
        for name in joints
        for quantity in ("damping", "armature")
    }
    simulator = npdr.MujocoSimulator(chain(number), addresses, sensors=joints)

    def model(inputs: Any) -> torch.Tensor:
        parameters = {
            p.name: pyro.sample(p.name, dist.Uniform(0.5 * p.nominal, 1.5 * p.nominal))
            for p in simulator.parameters
        }
        return npdr.simulate("trajectory", simulator, parameters, inputs)

    rollouts = recorded(number, seconds)
    searcher = Searcher(model, rollouts, npdr.DiscoveryOptions(), seed=0)
    begun = time.process_time()
    fitted = searcher.settled(searcher.fit_base(may_be_rough=True))
    row: dict[str, Any] = {"joints": number, "fit_seconds": time.process_time() - begun}
    everything = candidate_effects(fitted.simulator)
    for name, effects in (("all", everything), ("fourth", everything[::4])):
        begun = time.process_time()
        look(fitted, npdr.DiscoveryOptions(effects=effects))
        row[f"candidates_{name}"] = len(effects)
        row[f"screening_seconds_{name}"] = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return row | {"peak_gib": peak / 2**20}


def main() -> None:
    """Measures every number of joints and prints a table."""
    parser = argparse.ArgumentParser(description="Measures costs against the number of joints.")
    parser.add_argument("--joints", default=",".join(map(str, JOINTS)))
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of a rollout")
    parser.add_argument("--out", type=Path, default=Path("joint_costs.json"))
    parser.add_argument("--one", type=int, help="measure one number here and print its row")
    options = parser.parse_args()
    if options.one:
        torch.set_num_threads(1)
        print(json.dumps(measured(options.one, options.seconds)))
        return
    rows = []
    for number in options.joints.split(","):
        command = [sys.executable, __file__, "--one", number, "--seconds", str(options.seconds)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        options.out.write_text(json.dumps(rows, indent=1))
        shown = {k: round(v, 2) if isinstance(v, float) else v for k, v in rows[-1].items()}
        print(shown, flush=True)


if __name__ == "__main__":
    main()
