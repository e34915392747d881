"""What a fit leaves of a recording, with the initial states taken as true and fitted.

    python benchmarks/initial_states.py

Three rollouts of a rig in MuJoCo, by three policies near the default gains, are fitted by the
model that has the rig's effects. Residuals are those of the positions, in mrad.
"""

import argparse

import torch

from npdr_ppl.loop.control_task import control_task
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.reproduction.rig_study import furuta_with_effects
from npdr_ppl.rollouts import Rollouts

GAINS = (
    (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    (1.1, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0),
    (0.95, 0.9, 1.3, 1.2, 1.2, 1.2, 1.2),
)
"""Factors of the policy's parameters."""


def record(rig: str) -> Rollouts:
    """Returns one rollout of each policy."""
    task = control_task("furuta-swing-up")
    real = RealRollouts(furuta_target(rig), task, Furuta())
    nominal = {name: float(value) for name, value in Furuta().nominal().items()}
    first, *others = (
        real.collect(
            episode,
            task.policy.with_parameters(task.policy.parameters * torch.tensor(factors)),
            nominal,
            seed=episode,
        )
        for episode, factors in enumerate(GAINS)
    )
    return first.concatenate(*others)


def main() -> None:
    """Fits the rigs that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", default="furuta-hard,furuta-random-100,furuta-random-101")
    parser.add_argument("--segment-length", type=int, default=50)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = furuta_with_effects()
    print(f"{'rig':20} {'initial states':14} {'arm mrad':>9} {'pole mrad':>9}")
    for rig in arguments.rigs.split(","):
        rollouts = record(rig)
        for start in ("recorded", "estimated", "uncertain"):
            options = DataOptions("bayessim", arguments.segment_length, start, "float32")
            noise = prepare(model, rollouts, options).noise
            assert noise is not None  # the model declares none
            arm, pole = (1e3 * noise[name] for name in ("arm_angle", "pole_angle"))
            print(f"{rig:20} {start:14} {arm:9.2f} {pole:9.2f}", flush=True)


if __name__ == "__main__":
    main()
