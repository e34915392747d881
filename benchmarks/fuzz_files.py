"""Reads a hundred thousand damaged files: each is read or refused with one sentence.

Valid recordings, robots and run folders are damaged byte by byte, and in the ways that files of
their format get damaged. Anything but success or one sentence, warnings included, is a failure, as
is more memory than 1 GiB.

    python benchmarks/fuzz_files.py --files 100000 --seed 0
"""

import argparse
import functools
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import types
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import file_outcomes
import fuzz_logs
import numpy as np
import torch
from fuzz_csv_edits import BYTE_EDITS, NUMBERS, malformed

from npdr_ppl.rollouts import Rollouts

SECONDS = 20
"""Seconds after which reading one file counts as hanging."""

LARGEST_MEMORY = 1.0
"""GiB that a process may use, the libraries included."""

ROBOT = """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 -0.2"/>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""

VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**70, 10**400, 1e300, -0.5, "", "x", "\x1b[31m", "é" * 300, [], {}),
    *([[]], [None], {"a": 1}, "accept", [1, 2], {"mean": None}),
)

Rng = random.Random


def recording() -> Rollouts:
    """Returns two short rollouts."""
    rng = np.random.default_rng(0)
    return Rollouts.from_arrays(
        [rng.normal(size=(n + 1, 2)) for n in (6, 4)],
        [rng.normal(size=(n, 1)) for n in (6, 4)],
        channel_names=("angle", "rate"),
        action_names=("torque",),
        time_step=0.02,
        rewards=[rng.normal(size=n) for n in (6, 4)],
        channel_units=("rad", "rad/s"),
        action_units=("N m",),
    )


def write_pickle(path: Path) -> None:
    """Writes a rollout as SimuRLacra does."""
    import joblib

    module: Any = types.ModuleType("pyrado.sampling.step_sequence")
    module.StepSequence = type("StepSequence", (), {"__module__": module.__name__})
    names = [".".join(module.__name__.split(".")[: k + 1]) for k in range(3)]
    sys.modules.update(dict.fromkeys(names, module))
    rollout = module.StepSequence()
    rng = np.random.default_rng(0)
    rollout.__dict__ = {
        "observations": rng.normal(size=(6, 2)),
        "actions": rng.normal(size=(5, 1)),
        "rewards": rng.normal(size=5),
        "time": np.arange(6) * 0.1,
    }
    joblib.dump(rollout, path)
    for name in names:
        del sys.modules[name]


def write_runs(folder: Path) -> list[Path]:
    """Writes a small fit, and what a discovery and a training leave behind."""
    from npdr_ppl.inference.registry import backend
    from npdr_ppl.models.pendulum import pendulum
    from npdr_ppl.posterior.fit import fit
    from npdr_ppl.preparation.data_options import DataOptions

    rng = np.random.default_rng(0)
    steps = np.arange(61)
    angle = 0.3 * np.cos(3 * 0.02 * steps) + rng.normal(0, 0.002, 61)
    readings = np.stack([angle, np.gradient(angle, 0.02)], 1)
    rollouts = Rollouts.from_arrays(
        [readings],
        [np.zeros((60, 1))],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    )
    quick = backend("snpe-c", transforms=1, hidden=(8,), epochs=2, members=2)
    options = DataOptions("all/10", 20, "recorded")
    fit(
        pendulum, rollouts, None, out=folder / "fit", backend=quick, rounds=1,
        num_simulations=60, options=options, progress=False,
    )  # fmt: skip
    fitted = json.loads((folder / "fit" / "fit.json").read_text())
    effect = {
        "effect": "coulomb_friction",
        "port": "hinge",
        "probability": 0.93,
        "equivalent_to": ["stribeck_friction"],
        "parameters": {"level": {"mean": 0.4, "sd": 0.05, "hdi_94": [0.3, 0.5], "unit": "N m"}},
    }
    discovery = {
        "verdict": "named",
        "reason": "Friction is missing.",
        "alarm": {"p_value": 0.002, "fired": True},
        "where": [{"rollout": 0, "time_span": [0.2, 0.6], "channel": "a", "region": "b", "z": 7}],
        "effects": [effect],
        "ranking": [effect, {"effect": "input_delay", "port": "torque", "probability": 0.04}],
        "gap": {"rmse": {"before": 0.2, "after": 0.06, "noise_floor": 0.05, "closed": 0.93}},
        "next_experiment": {"amplitude": 1.5, "frequency": 0.5},
        "model": {"source": "def pendulum(inputs):\n    return 1\n"},
    }
    decision = {"decision": "accept", "reason": "It fits.", "action": "trained"}
    iteration = {
        "real_return": 12.5,
        "real_returns": [12.5],
        "decisions": [decision | {"diagnosis": fitted["diagnosis"]}],
        "internal_model": {"mass": 1.0},
        "parameters": fitted["parameters"],
        "effects": ["hinge.coulomb_friction"],
        "checks": [{"decision": "deploy", "reason": "It succeeds."}],
        "sim_return": 13.0,
        "simulated_success": 0.9,
    }
    training = {"iterations": [iteration, iteration], "policy": {"k": 1.5}, "deployed": 1}
    row = {key: fitted[key] for key in ("parameters", "diagnosis", "seconds")} | {
        "error": None,
        "elpd": 10.0,
        "elpd_difference": -2.0,
        "elpd_difference_se": 0.5,
        "coverage": {"50": 0.4, "80": 0.7},
        "decision": "accept",
    }
    comparison = {
        "backends": {"a": row, "b": row, "c": {"error": "It failed."}},
        "ranking": ["a", "b"],
        "weights": {"a": 0.7, "b": 0.3},
        "settings": {"rounds": 1, "num_simulations": 60, "evaluated_on": "fitted"},
    }
    contents = {"discovery": discovery, "train": training, "comparison": comparison}
    for name, content in contents.items():
        (folder / name).mkdir()
        (folder / name / f"{name}.json").write_text(json.dumps(content))
    (folder / "discovery" / "revised_model.py").write_text("def pendulum(inputs):\n    return 2\n")
    (folder / "train" / "rollouts").mkdir()
    rollouts.to_netcdf(folder / "train" / "rollouts" / "rollout_000.nc")
    return sorted(folder.iterdir())


@functools.cache
def originals(folder: Path) -> dict[str, list[Path]]:
    """Writes valid files and folders; returns their paths by format."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = recording()
    whole.to_parquet(folder / "x.parquet")
    whole.to_npz(folder / "x.npz")
    whole.to_netcdf(folder / "x.nc")
    write_pickle(folder / "x.pickle")
    (folder / "x.urdf").write_text(ROBOT)
    models = Path(file_outcomes.__file__).resolve().parents[1] / "models"
    shutil.copy(models / "two_link_arm.xml", folder / "x.mjcf")
    (folder / "runs").mkdir()
    file_outcomes.resume(folder / "begun")
    logs = fuzz_logs.write_logs(folder / "logs")
    found = {kind: [folder / f"x.{kind}"] for kind in ("parquet", "npz", "nc", "pickle")}
    return found | {
        "mjcf": [folder / "x.mjcf"],
        "urdf": [folder / "x.urdf"],
        "run": write_runs(folder / "runs"),
        "resume": [folder / "begun"],
        **logs,
    }


def damage(rng: Rng, data: bytes) -> bytes:
    """Returns bytes with one to three kinds of damage."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        rng.choice(BYTE_EDITS)(rng, result)
    return bytes(result)


def replace_number(rng: Rng, data: bytes) -> bytes:
    """Returns a text with another number in the place of one of its numbers."""
    places = list(re.finditer(rb"\d[\d.e-]*", data))
    if not places:
        return data
    place = rng.choice(places)
    number = rng.choice((*NUMBERS, "1000000", "-3", "99999999999")).encode(errors="replace")
    return data[: place.start()] + number + data[place.end() :]


def edit_json(rng: Rng, data: bytes) -> bytes:
    """Returns JSON with a value of another type, without a key, or nested deeply."""
    content = json.loads(data)
    target, key = rng.choice(list(_places(content)) or [({"": 0}, "")])
    edit = rng.random()
    if edit < 0.3:
        del target[key]
    elif edit < 0.9:
        target[key] = rng.choice(VALUES)
    text = json.dumps(content)
    if edit >= 0.9:
        depth = rng.choice((50, 300, 3_000, 100_000))
        at = text.rfind(":") + 1
        text = text[:at] + "[" * depth + "]" * depth + text[-1]
    return text.encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in entries:
        yield value, key
        if isinstance(item, dict | list):
            yield from _places(item)


def damaged_folder(rng: Rng, original: Path, path: Path) -> None:
    """Writes a copy of a folder in which one file is damaged or missing."""
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(original, path)
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.name != ".lock")
    chosen = [file for file in files if file.suffix == ".json" and rng.random() < 0.8] or files
    file = rng.choice(chosen)
    data = file.read_bytes()
    if rng.random() < 0.03:
        file.unlink()
    elif file.suffix == ".json" and rng.random() < 0.7:
        file.write_bytes(edit_json(rng, data))
    else:
        file.write_bytes(damage(rng, data))


def one(kind: str, seed: int, index: int, folder: Path) -> tuple[str, str]:
    """Damages and reads one file, the same for the same seed; returns outcome and message."""
    rng = random.Random(f"{kind}/{seed}/{index}")
    if kind == "csv":
        path = folder / "fuzz.csv"
        path.write_bytes(malformed(rng))
        return file_outcomes.outcome(kind, path)
    original = rng.choice(originals(folder / "originals")[kind])
    path = folder / f"fuzz.{kind.removeprefix('log_')}"
    if original.is_dir():
        damaged_folder(rng, original, path)
        return file_outcomes.outcome(kind, path)
    data = original.read_bytes()
    edits: tuple[Callable[[Rng, bytes], bytes], ...] = (damage,)
    if kind in ("mjcf", "urdf", "log_csv", "toml"):
        edits = (damage, replace_number, replace_number)
    path.write_bytes(rng.choice(edits)(rng, data))
    return file_outcomes.outcome(kind, path)


def fuzz(
    kind: str, seed: int, first: int, last: int, folder: Path
) -> tuple[Counter[str], Counter[str], list[str]]:
    """Reads files ``first`` to ``last − 1`` of a format in children of this process.

    Returns:
        Numbers by outcome, numbers by kind of sentence, and descriptions of failures.
    """
    if kind != "csv":
        originals(folder / "originals")
    outcomes: Counter[str] = Counter()
    sentences: Counter[str] = Counter()
    failures: list[str] = []
    index = first
    while index < last:
        for found, message in _in_a_child(kind, seed, index, last, folder):
            outcomes[found] += 1
            if found == "refused":
                sentences[file_outcomes.kind_of(message)] += 1
            elif found != "read":
                failures.append(f"{kind}, file {index}: {message}")
            index += 1
    return outcomes, sentences, failures


def _in_a_child(
    kind: str, seed: int, first: int, last: int, folder: Path
) -> Iterator[tuple[str, str]]:
    """Yields outcomes until all files are read or the child has died, which is one outcome."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        # What engines write to the terminal is not looked at.
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        torch.set_num_threads(1)  # threads do not survive a fork
        for index in range(first, last):
            signal.alarm(SECONDS)
            answer = one(kind, seed, index, folder)
            os.write(writing, (json.dumps(answer) + "\n").encode())
        os._exit(0)
    os.close(writing)
    count = 0
    with os.fdopen(reading) as pipe:
        for line in pipe:
            count += 1
            yield tuple(json.loads(line))
    _, status = os.waitpid(child, 0)
    if first + count < last:
        yield "died", f"signal {status & 127}"


def main() -> int:
    """Runs the benchmark and prints its figures; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--files", type=int, default=100_000, help="over all formats together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--formats", default=",".join(file_outcomes.FORMATS))
    parser.add_argument("--json", type=Path, help="where to write the figures")
    options = parser.parse_args()
    kinds = options.formats.split(",")
    figures: dict[str, Any] = {"files": options.files, "seed": options.seed}
    is_right = True
    with tempfile.TemporaryDirectory() as folder:
        for kind in kinds:
            started = time.perf_counter()
            last = options.files // len(kinds)
            outcomes, sentences, failures = fuzz(kind, options.seed, 0, last, Path(folder))
            seconds = time.perf_counter() - started
            print(f"{kind}: {dict(outcomes)} in {seconds:.0f} s", flush=True)
            for sentence, count in sentences.most_common(8):
                print(f"{count:8d}  {sentence}")
            for failure in failures[:20]:
                print(failure, file=sys.stderr, flush=True)
            figures[kind] = {"outcomes": dict(outcomes), "sentences": dict(sentences)}
            is_right &= not failures
    # Of the children that read the files, the libraries included.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"largest memory of a process: {peak:.2f} GiB")
    figures["peak_gib"] = peak
    is_right &= peak <= LARGEST_MEMORY
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2))
    return int(not is_right)


if __name__ == "__main__":
    sys.exit(main())
