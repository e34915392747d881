"""The whole SO-101 behind its servos: fitted on 14 motions, judged on the six others.

    python benchmarks/so101_arm.py --data ../shared/data/so101 --out so101_arm.json

The six motions are every third one in the order of the alphabet. The model is the arm's MJCF file
in MuJoCo with all six joints. Of each servo, kp, kv (with the damping of its joint), armature, dry
friction and how far it yields are fitted, and what ``--laws`` adds. Masses stay those of the file,
whose weight sets the scale of all torques.

Behind stiff servos the joints nearly decouple: another kp of the wrist hardly moves the shoulder.
Each Gauss-Newton step therefore changes the same number of all six servos in one simulation, and
solves for each joint alone. Six joints cost as many simulations as one. The misfit is that of
whole motions, simulated from the first sample without resynchronisation, as the result is judged.
In places the arm touches something, which the file does not contain, so errors above
``LARGE_ERROR`` count in proportion to their size, not to its square (Huber 1964).
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# The copy of the package beside this file is judged, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
import torch  # noqa: E402
from torch import Tensor  # noqa: E402

import npdr_ppl as npdr  # noqa: E402
from npdr_ppl.language.effects import Effect  # noqa: E402
from npdr_ppl.language.inputs import Inputs  # noqa: E402
from npdr_ppl.models.effects import EncoderBias, InputDelay  # noqa: E402

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

JUDGED = JOINTS[:5]
"""The joints that are judged; the gripper's angle is logged on a scale of its own."""

TIME_STEP = 0.02006
"""Mean time between samples, s; it differs by less than 0.1 % between the motions."""

FIELDS = {"kp": "actuator {} kp", "kv": "actuator {} kv", "armature": "joint {} armature"}
FIELDS |= {"friction": "joint {} frictionloss", "softness": "joint {} friction_softness"}

STARTS = {"kp": 20.0, "kv": 1.5, "armature": 0.028, "friction": 0.1, "softness": 0.01}
STARTS |= {"delay": 0.03, "offset": 0.0}
"""Where the fit begins. The file's kp of 998 N m/rad reaches the force limit at errors of 3 mrad,
where the motion no longer depends on kp."""

STEPS = {"kp": 0.02, "kv": 0.02, "armature": 0.05, "friction": 0.05, "softness": 0.1}
STEPS |= {"delay": 2e-3, "offset": 1e-3}
"""Changes for derivatives: of logarithms, of the delay in s and of the offset in rad."""

LARGEST = {"kp": 0.7, "kv": 0.7, "armature": 0.7, "friction": 0.7, "softness": 1.5}
LARGEST |= {"delay": 0.015, "offset": 0.02}
"""Largest changes in one step, in the same units."""

LARGE_ERROR = 0.01
"""Errors in rad from which the arm may have touched something: 6.5 steps of its encoders."""

ADDITIVE = ("delay", "offset")
"""Numbers that are not changed in logarithms."""

LAWS: dict[str, tuple[type[Effect], str, str]] = {
    "delay": (InputDelay, "{}_command", "delay"),
    "offset": (EncoderBias, "{}", "offset"),
}
"""Effect, port and parameter of each law that may be added."""

DAMPINGS = (0.0, 0.03, 1.0, 30.0)
"""Factors on the curvature that are tried in each step (Marquardt 1963)."""


@dataclass(frozen=True)
class Motions:
    """Recorded motions.

    Attributes:
        names: Their names.
        inputs: Inputs, one segment for each motion.
        measured: Angles after each step, ``(motions, steps, joints)``, rad.
    """

    names: tuple[str, ...]
    inputs: Inputs
    measured: Tensor


def motions(folder: Path, names: Sequence[str]) -> Motions:
    """Reads motions.

    Args:
        folder: Where the Parquet files are.
        names: Their names without the ending.
    """
    readings, actions = [], []
    for name in names:
        table = pd.read_parquet(folder / f"{name}.parquet")
        angles = table[[f"{joint}_position" for joint in JOINTS]].to_numpy(float)
        goals = table[[f"{joint}_command" for joint in JOINTS]].ffill().to_numpy(float)
        # At rest before the first goal.
        readings.append(np.concatenate((angles, np.zeros_like(angles)), axis=1))
        actions.append(goals[:-1])
    rollouts = npdr.Rollouts.from_arrays(
        readings=readings,
        actions=actions,
        channel_names=[*JOINTS, *(f"{joint}_velocity" for joint in JOINTS)],
        action_names=[f"{joint}_command" for joint in JOINTS],
        time_step=TIME_STEP,
    )
    inputs = rollouts.inputs(segment_length=None, initial_state="recorded")
    return Motions(tuple(names), inputs, rollouts.observation(inputs, JOINTS))


class Arm:
    """The arm with the numbers that are fitted.

    Args:
        file: Its MJCF file.
        laws: Laws to add, of ``LAWS``.
    """

    def __init__(self, file: Path, laws: Sequence[str]) -> None:
        self.numbers = (*FIELDS, *laws)
        addresses = {f"{j}_{n}": FIELDS[n].format(j) for n in FIELDS for j in JOINTS}
        base = npdr.MujocoSimulator(file, addresses, time_step=TIME_STEP, substeps=10)
        effects = [LAWS[law][0](LAWS[law][1].format(j)) for law in laws for j in JOINTS]
        self.simulator = base.with_effects(*effects)

    def simulate(self, values: Mapping[str, Tensor], recorded: Motions) -> Tensor:
        """Returns simulated angles, ``(draws, motions, steps, joints)``.

        Args:
            values: Each number, ``(draws, joints)``.
            recorded: The motions to repeat.
        """
        given = {}
        for number, table in values.items():
            for joint, column in zip(JOINTS, table.unbind(-1), strict=True):
                if number in LAWS:
                    _, port, parameter = LAWS[number]
                    name = f"{port.format(joint)}.{LAWS[number][0].id}.{parameter}"
                else:
                    name = f"{joint}_{number}"
                given[name] = column
        return self.simulator.simulate(given, recorded.inputs)[..., : len(JOINTS)]

    def changed(self, values: Mapping[str, Tensor], number: str, by: Tensor) -> Tensor:
        """Returns a number of all joints, changed by steps in the units of ``STEPS``."""
        old = values[number]
        if number in ADDITIVE:
            return (old + by).clamp_min(0.0) if number == "delay" else old + by
        return old * by.exp()


def squares(simulated: Tensor, recorded: Motions) -> Tensor:
    """Returns the mean squared error of each joint over all samples, ``(draws, joints)``, rad²."""
    mask = recorded.inputs.mask
    error = (simulated - recorded.measured)[:, mask]
    return error.square().mean(-2).nan_to_num(math.inf)


def losses(simulated: Tensor, recorded: Motions) -> Tensor:
    """Returns the mean loss of each joint over all samples, ``(draws, joints)``, rad²."""
    size = (simulated - recorded.measured)[:, recorded.inputs.mask].abs()
    straight = LARGE_ERROR * (2.0 * size - LARGE_ERROR)
    return torch.where(size < LARGE_ERROR, size.square(), straight).mean(-2).nan_to_num(math.inf)


def fitted(arm: Arm, recorded: Motions, rounds: int) -> dict[str, Tensor]:
    """Fits the numbers of all joints; returns each, ``(joints,)``.

    Args:
        arm: The arm.
        recorded: Motions to fit.
        rounds: Gauss-Newton steps.
    """
    ones = torch.ones(len(JOINTS), dtype=torch.float64)
    values = {number: STARTS[number] * ones for number in arm.numbers}
    count, mask = len(arm.numbers), recorded.inputs.mask
    for turn in range(rounds):
        begun = time.process_time()
        tried = {n: v.repeat(count + 1, 1) for n, v in values.items()}
        for row, number in enumerate(arm.numbers, 1):
            step = torch.as_tensor(STEPS[number], dtype=torch.float64)
            tried[number][row] = arm.changed(values, number, step)
        simulated = arm.simulate(tried, recorded)
        now = losses(simulated[:1], recorded)[0]
        base = simulated[0][mask]  # (samples, joints)
        steps = torch.tensor([STEPS[number] for number in arm.numbers], dtype=torch.float64)
        slopes = torch.stack([s[mask] - base for s in simulated[1:]], -1) / steps
        residual = recorded.measured[mask] - base
        # The square of a large residual is replaced by one with the slope of its loss.
        weights = (LARGE_ERROR / residual.abs().clamp_min(LARGE_ERROR))[..., None]
        curvature = torch.einsum("tjm,tjn->jmn", weights * slopes, slopes)
        gradient = torch.einsum("tjm,tj->jm", weights * slopes, residual)
        moves = []
        for factor in DAMPINGS:
            diagonal = torch.diag_embed(curvature.diagonal(dim1=-2, dim2=-1))
            damped = curvature + factor * diagonal + 1e-12 * torch.eye(count)
            moves.append(torch.linalg.solve(damped, gradient))
        move = torch.stack(moves)  # (dampings, joints, numbers)
        limits = torch.tensor([LARGEST[number] for number in arm.numbers], dtype=torch.float64)
        move = torch.maximum(torch.minimum(move, limits), -limits)
        tried = {n: arm.changed(values, n, move[..., k]) for k, n in enumerate(arm.numbers)}
        found = losses(arm.simulate(tried, recorded), recorded)
        best = found.argmin(0)
        joint = torch.arange(len(JOINTS))
        is_better = found[best, joint] < now
        for number in arm.numbers:
            chosen = tried[number][best, joint]
            values[number] = torch.where(is_better, chosen, values[number])
        shown = "  ".join(f"{1e3 * value:.2f}" for value in now.sqrt().tolist())
        spent = time.process_time() - begun
        print(f"step {turn}: root of the loss {shown} mrad, {spent:.0f} s of CPU", flush=True)
        if not bool(is_better.any()):
            break
    return values


def table(arm: Arm, values: Mapping[str, Tensor], recorded: Motions) -> dict[str, object]:
    """Returns the RMSE of each joint, over all samples and by motion, in mrad."""
    simulated = arm.simulate({n: v[None] for n, v in values.items()}, recorded)
    total = 1e3 * squares(simulated, recorded)[0].sqrt()
    by_motion = {}
    for row, name in enumerate(recorded.names):
        error = (simulated[0, row] - recorded.measured[row])[recorded.inputs.mask[row]]
        by_motion[name] = dict(
            zip(JOINTS, (1e3 * error.square().mean(0).sqrt()).tolist(), strict=True)
        )
    return {"all": dict(zip(JOINTS, total.tolist(), strict=True)), "by_motion": by_motion}


def main() -> None:
    """Fits, judges, and writes the result."""
    parser = argparse.ArgumentParser(description="The SO-101, fitted and judged.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data/so101"))
    parser.add_argument("--laws", default="", help="of " + ", ".join(LAWS))
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--every", type=int, default=1, help="fit every n-th of the 14 motions")
    parser.add_argument("--out", type=Path, default=Path("so101_arm.json"))
    arguments = parser.parse_args()
    names = sorted(path.stem for path in arguments.data.glob("*.parquet"))
    held_out = names[2::3]
    arm = Arm(arguments.data / "so101.xml", [law for law in arguments.laws.split(",") if law])
    fit = [name for name in names if name not in held_out][:: arguments.every]
    train = motions(arguments.data, fit)
    test = motions(arguments.data, held_out)
    begun = time.process_time()
    values = fitted(arm, train, arguments.rounds)
    result = {
        "laws": arguments.laws,
        "cpu_seconds": time.process_time() - begun,
        "values": {n: dict(zip(JOINTS, v.tolist(), strict=True)) for n, v in values.items()},
        "fitted": table(arm, values, train),
        "held_out": table(arm, values, test),
    }
    arguments.out.write_text(json.dumps(result, indent=2))
    for part in ("fitted", "held_out"):
        own = [result[part]["all"][joint] for joint in JUDGED]
        shown = ", ".join(f"{j} {e:.1f}" for j, e in zip(JUDGED, own, strict=True))
        print(f"{part}: {shown} mrad; median {np.median(own):.1f}, worst {max(own):.1f}")


if __name__ == "__main__":
    main()
