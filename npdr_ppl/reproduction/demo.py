"""The demonstration: a policy runs on a rig, discovery mends the model, a new policy is trained.

The device is a Furuta pendulum in MuJoCo. It has MuJoCo's own dry friction of the arm and filtered
velocities, which the paper's equations lack. A policy is trained on the prior and runs on the rig.
The posterior is inferred and diagnosed. Discovery finds that no parameters explain the rollout,
and names the missing effects. The policy is then trained again with the revised model.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from npdr_ppl.discovery import DiscoveryOptions
from npdr_ppl.loop.control_task import ControlTask, control_task
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.loop.loop_result import Training
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.models.furuta_targets import FurutaTarget
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.randomness import derived_seed
from npdr_ppl.run_files import read_json, write_json
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["DEMO_OPTIONS", "RIG", "Demonstration", "run_demo"]

RIG = FurutaRig(
    parameters={
        "motor_resistance": 7.8,
        "motor_constant": 0.040,
        "arm_mass": 0.100,
        "arm_length": 0.078,
        "pole_mass": 0.026,
        "pole_length": 0.138,
        "arm_damping": 2e-4,
        "pole_damping": 1e-5,
    },
    arm_friction=1.2e-3,
    velocity_time_constant=0.008,
)
"""True parameters of the rig: up to 10 % from the nominal values, plus effects the model lacks."""

DEMO_OPTIONS = LoopOptions(
    iterations=1,
    extra_rollouts=1,
    rounds=1,
    extra_rounds=0,
    num_simulations=2_000,
    search="cma-es",
    search_iterations=45,
    num_domains=30,
    num_initial_states=2,
    deploys="last",
    discovers="after diagnosis",
    discovery=DiscoveryOptions(max_effects=2),
)
"""Settings for a short demo; a study needs more simulations, domains and iterations. The second
policy is checked before it runs on the rig: a search this short may find none that works."""


@dataclass(frozen=True)
class Demonstration:
    """Result of the demonstration.

    Attributes:
        training: The run of the loop.
        target: The rig.
        task: The control task of the policy.
        result: The content of ``demo.json``.
    """

    training: Training
    target: FurutaTarget
    task: ControlTask
    result: dict[str, Any]


def run_demo(
    out: Path,
    *,
    seed: int = 0,
    options: DataOptions | None = None,
    loop: LoopOptions | None = None,
    num_steps: int | None = None,
    progress: bool | Reporter | None = None,
) -> Demonstration:
    """Runs the demonstration in a folder, from a policy of the prior to one of the revised model.

    Args:
        out: Folder for the run and ``demo.json``; an interrupted run in it continues.
        seed: Seed of everything random.
        options: How rollouts are prepared; ``LOOP_DATA`` if ``None``.
        loop: Options of the loop; ``DEMO_OPTIONS`` if ``None``.
        num_steps: Steps of an episode; the task's if ``None``.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
    """
    started = time.process_time()
    target = FurutaTarget("demo-rig", RIG)
    task = control_task("furuta-swing-up")
    if num_steps is not None:
        task = replace(task, num_steps=num_steps)
    with reporter(progress) as report:
        training = train(
            furuta,
            target,
            task,
            options=options,
            loop=loop or DEMO_OPTIONS,
            out=out,
            seed=seed,
            progress=report,
        )
        step = report.stage("run the last policy on the rig")
        after = RealRollouts(target, task, Furuta(), out / "last_policy").collect(
            0, training.policy, training.domain, seed=derived_seed(seed, "judged episode", 0)
        )
        step(1.0, "")
    assert after.rewards is not None
    last = training.iterations[-1]
    revision = out / "revision_0" / "discovery.json"
    found = read_json(revision, DiscoveryRecord) if revision.exists() else {}
    result = {
        "returns": {
            "policy from the prior": training.iterations[0]["real_return"],
            "policy from the revised model": float(after.rewards[0].sum()),
        },
        "success": task.success,
        "decisions": last["decisions"],
        "verdict": found.get("verdict"),
        "effects": found.get("effects", []),
        "truth": {
            "parameters": dict(RIG.parameters),
            "arm.friction": RIG.arm_friction,
            "velocity_filter": RIG.velocity_time_constant,
        },
        "cpu_seconds": time.process_time() - started,
    }
    write_json(out / "demo.json", result)
    return Demonstration(training, target, task, result)
