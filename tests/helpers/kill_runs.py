"""Kills a run of the NPDR loop at random moments, resumes it, and compares what comes out.

    python kill_runs.py FOLDER NUM_KILLS SEED [discover | check]

One process imports everything, also what a run imports later, and forks a child for every
attempt, so that a hundred take minutes.
It exits with an error if a resumed run differs from the undisturbed one, or if the target ran an
episode again that had finished. The target writes an episode down after it has finished, so a kill
right between the two leaves an episode that is not written down, but never one that is twice.
"""

import contextlib
import importlib
import json
import os
import random
import signal
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path

import torch

from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.small_loop import (
    SMALL_DATA,
    DryPendulum,
    HandmadePendulum,
    accurate_pendulum,
    discovering_options,
    small_options,
    small_task,
    swinging_task,
    without_remedies,
)


def import_what_a_run_needs(folder, seed, mode):
    """Imports what a run has imported in the end, so that its children need not."""
    names = folder.with_suffix(".modules")
    finish(fork(folder, seed, mode, names))
    for name in names.read_text().split():
        with contextlib.suppress(Exception):
            importlib.import_module(name)


def fork(folder, seed, mode, modules=None):
    """Starts the run, or goes on with it, in a process of its own."""
    child = os.fork()
    if child:
        return child
    try:
        folder.mkdir(parents=True, exist_ok=True)
        model, target, task, options = pendulum, HandmadePendulum, small_task(), small_options()
        context = contextlib.nullcontext()
        if mode == "discover":
            context = without_remedies()
            model, target = accurate_pendulum, DryPendulum
            task, options = swinging_task(), discovering_options()
        if mode == "check":
            # No policy succeeds, so the loop does all that a check can ask for.
            task = replace(small_task(), success=1e9)
            options = small_options(iterations=1, extra_rollouts=1, least_success=0.5)
        with context:
            train(model, target(folder / "episodes.log"), task, options=SMALL_DATA, loop=options,
                  out=folder / "run", seed=seed, progress=False)  # fmt: skip
        if modules is not None:
            modules.write_text("\n".join(sys.modules))
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


def finish(child):
    _, status = os.waitpid(child, 0)
    if status:
        raise SystemExit(f"a run failed with status {status}")


def outcome(folder):
    return {
        "train": json.loads((folder / "run/train.json").read_text()),
        "rollouts": [
            file.read_text()
            for file in sorted((folder / "run/rollouts").glob("rollout_[0-9][0-9][0-9].jsonl"))
        ],
    }


def episodes(folder):
    """The numbers of the episodes that the target has finished, in order."""
    log = folder / "episodes.log"
    return [int(number) for number in log.read_text().split()] if log.exists() else []


def written(folder):
    """The names of the files that a run has on disk: how far it has come."""
    return tuple(sorted(str(file.relative_to(folder)) for file in folder.rglob("*.*")))


def main():
    root, num_kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    mode = sys.argv[4] if len(sys.argv) > 4 else ""
    torch.set_num_threads(1)
    moments = random.Random(seed)
    started = time.monotonic()
    if mode == "discover":
        # Takes so much longer than its imports that one run will do for both.
        import_what_a_run_needs(root / "undisturbed", seed, mode)
        seconds = 0.8 * (time.monotonic() - started)
    else:
        import_what_a_run_needs(root / "first", seed, mode)
        started = time.monotonic()
        finish(fork(root / "undisturbed", seed, mode))
        seconds = time.monotonic() - started
    expected = outcome(root / "undisturbed")
    planned = episodes(root / "undisturbed")
    if planned != list(range(len(expected["rollouts"]))):
        raise SystemExit(f"the undisturbed run made episodes {planned}")
    kills = runs = unwritten = 0
    stages = set()
    while kills < num_kills:
        folder = root / f"run_{runs}"
        runs += 1
        is_done = False
        # Lives are shorter than a run, so that it is killed on its way, and longer than its start,
        # in which nothing is written and which can take a third of it. They get longer after each
        # kill, so that it comes to its end also where the machine has become slower since.
        # Discovery begins anew after a kill, so it needs lives that are longer than it is.
        longest = (1.0 if mode == "discover" else 0.8) * seconds
        while not is_done:
            child = fork(folder, seed, mode)
            time.sleep(moments.uniform(0.0, longest))
            longest *= 1.1
            if kills < num_kills:
                os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            is_done = status == 0
            if os.WIFSIGNALED(status):
                kills += 1
                stages.add(written(folder))
            elif status:
                raise SystemExit(f"{folder}: a resumed run failed with status {status}")
        found = outcome(folder)
        for name, value in expected.items():
            if found[name] != value:
                raise SystemExit(f"{folder}: {name} differ from those of the undisturbed run")
        made = episodes(folder)
        if len(made) > len(set(made)) or not set(made) <= set(planned):
            raise SystemExit(f"{folder}: episodes {made} were made instead of {planned}")
        unwritten += len(planned) - len(made)
    summary = {"kills": kills, "runs": runs, "stages": len(stages), "unwritten": unwritten}
    print(json.dumps({**summary, "seconds": seconds}))


if __name__ == "__main__":
    main()
