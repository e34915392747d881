"""Twelve parameters of a six-joint arm, fitted by npdr_ppl and by mujoco.sysid side by side.

    pip install "mujoco[sysid]"
    python benchmarks/sysid.py --seeds 0,1 --seconds 5 --out sysid.jsonl
    python benchmarks/sysid.py --summary sysid.jsonl

The arm of :mod:`servo_arms_links` stands behind position servos. Its drives' true values differ
from the file's by up to 20 %. The rig is simulated by the Runge-Kutta method in steps of 0.25 ms;
encoders record positions only, at 500 Hz with a noise of 2e-4 rad, in two rollouts that begin at
rest. All methods have the same file (implicitfast, steps of 2 ms), and the same parameters with
the same ranges; they begin in the middle of these. There are two sets of parameters:

* drives: armature and damping of each joint;
* friction: damping and dry friction of each joint, of which the rig has none. Armatures are known.

Methods run one after the other, each in a process of its own on one thread:

* sysid: mujoco.sysid with its defaults, from the first measurement, at rest. It compares positions
  with the state, because sensors describe the state before a step;
* sysid-rk4: the same, after a user has changed the file's integrator to Runge-Kutta;
* closest: what ``npdr discover`` fits first: parameters, initial states, integration steps;
* fit: all of ``npdr fit``, only if named by ``--methods``; its most likely parameters.

CPU seconds are those of the fit without imports; of ``npdr fit``, those of its whole process.
"""

import argparse
import importlib
import itertools
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

# The copy of the package beside this file is measured, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
from clean_fits_runs import run  # noqa: E402
from servo_arms_cases import SPREAD, recorded  # noqa: E402
from servo_arms_links import ARMS, TIME_STEP, Arm, Array, Values, mjcf  # noqa: E402

import npdr_ppl as npdr  # noqa: E402
from npdr_ppl.cli.resolve import resolve_model  # noqa: E402
from npdr_ppl.discovery.discovery_options import DiscoveryOptions  # noqa: E402
from npdr_ppl.discovery.search.effect_search import Searcher  # noqa: E402
from npdr_ppl.randomness import derived_seed  # noqa: E402

SETS = {"drives": ("armature", "damping"), "friction": ("damping", "frictionloss")}
"""What is fitted at each joint."""

RANGE = 0.4
"""Greatest relative difference from the file's value that the range of a parameter allows."""

MOST_FRICTION = 0.04
"""Upper end of the range of dry friction, a share of the joint's greatest torque."""

NOTICEABLE_FRICTION = 1e-3
"""Dry friction above this share of the joint's greatest torque counts as reported. It is a tenth
of the least that :mod:`servo_arms_cases` hides."""

MODEL = '''"""The arm of arm.xml with twelve unknown parameters."""

from pathlib import Path

import npdr_ppl as npdr
import pyro
import pyro.distributions as dist

ADDRESSES = {addresses}
RANGES = {ranges}

arm = npdr.MujocoSimulator(Path(__file__).with_name("arm.xml"), ADDRESSES)


def model(inputs):
    parameters = {{name: pyro.sample(name, dist.Uniform(*ends)) for name, ends in RANGES.items()}}
    return npdr.simulate("trajectory", arm, parameters, inputs)
'''
"""The user's program."""


class Unknown(NamedTuple):
    """A parameter to be fitted: its joint, its quantity, the rig's value and its range."""

    joint: str
    quantity: str
    truth: float
    low: float
    high: float

    @property
    def name(self) -> str:
        """Name in the model."""
        return f"{self.quantity}_{self.joint}"


def unknowns(arm: Arm, true: Values, which: str) -> Iterator[Unknown]:
    """Yields the parameters of a set."""
    for quantity, (i, link) in itertools.product(SETS[which], enumerate(arm.links)):
        truth, low, high = 0.0, 0.0, MOST_FRICTION * link.limit
        if quantity != "frictionloss":
            given, truth = getattr(link, quantity), float(getattr(true, f"{quantity}s")[i])
            low, high = (1.0 - RANGE) * given, (1.0 + RANGE) * given
        yield Unknown(link.joint, quantity, truth, low, high)


def make_case(folder: Path, which: str, seed: int, seconds: float) -> list[Unknown]:
    """Writes ``arm.xml``, ``arm_model.py`` and ``rec.npz``; returns what is to be fitted."""
    arm, rng = ARMS["six"], np.random.default_rng(derived_seed(seed, "sysid"))
    public, factors = arm.public, rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, (2, len(arm.links)))
    true = Values(public.masses, public.armatures * factors[0], public.dampings * factors[1])
    known = public if which == "drives" else replace(public, armatures=true.armatures)
    found = list(unknowns(arm, true, which))
    addresses = {each.name: f"joint {each.joint} {each.quantity}" for each in found}
    ranges = {each.name: (each.low, each.high) for each in found}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(mjcf(arm, known))
    (folder / "arm_model.py").write_text(MODEL.format(addresses=addresses, ranges=ranges))
    (folder / "unknowns.json").write_text(json.dumps(found))
    given = [commands(arm, seconds, rng) for _ in range(2)]
    recorded(arm, true, given, (), 8, seed).to_npz(folder / "rec.npz")
    return found


def commands(arm: Arm, seconds: float, rng: np.random.Generator) -> Array:
    """Returns sums of four sines of 0.1 to 0.8 Hz, ``(steps, n)``, in rad."""
    times, number = TIME_STEP * np.arange(round(seconds / TIME_STEP)), len(arm.links)
    frequency, phase = rng.uniform(0.1, 0.8, (4, number)), rng.uniform(0.0, math.tau, (4, number))
    waves = np.sin(math.tau * frequency * times[:, None, None] + phase)
    weighted = (rng.dirichlet(np.ones(4), number).T * waves).sum(1)
    home, amplitude = np.array([(link.home, link.amplitude) for link in arm.links]).T
    return home + amplitude * weighted


Fitted = tuple[dict[str, float], float]
"""Estimates, and the CPU seconds that they took."""


def fit_by_sysid(folder: Path, *, is_rk4: bool = False) -> Fitted:
    """Fits by mujoco.sysid, with the file's own integrator or the Runge-Kutta method."""
    mujoco: Any = importlib.import_module("mujoco")
    sysid: Any = importlib.import_module("mujoco.sysid")
    asked = [Unknown(*each) for each in json.loads((folder / "unknowns.json").read_text())]
    rollouts = npdr.Rollouts.from_npz(folder / "rec.npz")
    begun = time.process_time()
    spec = mujoco.MjSpec.from_file(str(folder / "arm.xml"))
    if is_rk4:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    arm = spec.compile()
    signals = [f"{arm.joint(number).name}_qpos" for number in range(arm.njnt)]
    sequences = []
    for readings, actions in zip(rollouts.readings, rollouts.actions, strict=True):
        positions, targets = np.asarray(readings), np.asarray(actions)
        times = TIME_STEP * np.arange(len(positions))
        # A command per measurement is expected, of which the last is not used.
        control = sysid.TimeSeries(times, np.concatenate((targets, targets[-1:])))
        start = sysid.create_initial_state(arm, positions[0])
        seen = sysid.TimeSeries.from_names(times, positions, arm, signals)
        own = "arm", spec, f"rollout_{len(sequences)}", start, control, seen
        sequences.append(sysid.ModelSequences(*own, allow_missing_sensors=True))
    fitted = sysid.ParameterDict()
    for each in asked:

        def write(spec: Any, parameter: Any, each: Unknown = each) -> None:
            value = parameter.value[0]
            # Damping is a polynomial in the speed.
            value = [value, 0.0, 0.0] if each.quantity == "damping" else value
            setattr(spec.joint(each.joint), each.quantity, value)

        middle = 0.5 * (each.low + each.high)
        fitted.add(sysid.Parameter(each.name, middle, each.low, each.high, modifier=write))
    residual = sysid.build_residual_fn(models_sequences=sequences, n_threads=1)
    best, _ = sysid.optimize(initial_params=fitted, residual_fn=residual)
    took = time.process_time() - begun
    return {each.name: float(best[each.name].value[0]) for each in asked}, took


def fit_closest(folder: Path) -> Fitted:
    """Fits by npdr_ppl without a posterior."""
    rollouts = npdr.Rollouts.from_npz(folder / "rec.npz")
    begun = time.process_time()
    model = resolve_model(f"{folder / 'arm_model.py'}:model")
    searcher = Searcher(model, rollouts, DiscoveryOptions())
    found = searcher.settled(searcher.fit_base(may_be_rough=True))
    took = time.process_time() - begun
    return {name: float(value) for name, value in found.parameters.items()}, took


FITS = {"sysid": fit_by_sysid, "sysid-rk4": partial(fit_by_sysid, is_rk4=True)}
FITS |= {"closest": fit_closest}
METHODS = (*FITS, "fit")
"""All methods; the first is the one that the others are compared with."""


def measure(folder: Path, method: str, found: Sequence[Unknown]) -> dict[str, Any]:
    """Fits in a process of its own, and returns what a row says of it."""
    out, command = folder / method, [sys.executable, __file__, "--one", method, str(folder)]
    if method == "fit":
        command = [sys.executable, "-m", "npdr_ppl.cli", "fit", f"{folder}/arm_model.py:model"]
        command += ["--data", str(folder / "rec.npz"), "--out", str(out)]
    outcome = run(command)
    row: dict[str, Any] = {"message": outcome.message, "wall_seconds": outcome.seconds}
    if row["message"]:
        return row
    if method == "fit":
        estimates = json.loads((out / "fit.json").read_text())["most_likely"]
        took = outcome.cpu_seconds
    else:
        estimates, took = json.loads(out.with_name(f"{method}.json").read_text())
    return row | {"cpu_seconds": took, **errors(found, estimates)}


def errors(found: Sequence[Unknown], estimates: Mapping[str, float]) -> dict[str, Any]:
    """Returns relative errors, and dry friction as a share of the joint's greatest torque."""
    limits = {link.joint: link.limit for link in ARMS["six"].links}
    relative, friction = {}, {}
    for each in found:
        if each.quantity == "frictionloss":
            friction[each.name] = estimates[each.name] / limits[each.joint]
        else:
            relative[each.name] = estimates[each.name] / each.truth - 1.0
    return {"relative": relative, "friction": friction}


def figures(own: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Returns what the table says of one method's rows for one set of parameters."""
    made = [row for row in own if not row["message"]]
    found: dict[str, float] = {"failed": len(own) - len(made)}
    if not made:
        return found
    relative = [abs(error) for row in made for error in row["relative"].values()]
    friction = [share for row in made for share in row["friction"].values()]
    found["CPU seconds, median"] = median(row["cpu_seconds"] for row in made)
    found["relative error in %, median"] = 100.0 * median(relative)
    found["relative error in %, worst"] = 100.0 * max(relative)
    if friction:
        reported = sum(share > NOTICEABLE_FRICTION for share in friction)
        found["joints with friction reported, of 6"] = 6.0 * reported / len(friction)
        found["largest friction, % of greatest torque"] = 100.0 * max(friction)
    return found


def table(every: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yields the lines of the table; ratios are to the first method."""
    for which in (name for name in SETS if any(row["set"] == name for row in every)):
        own = [row for row in every if row["set"] == which]
        names = [name for name in METHODS if any(row["method"] == name for row in own)]
        found = [figures([row for row in own if row["method"] == name]) for name in names]
        yield f"{which}: {', '.join(SETS[which])}; {len({r['seed'] for r in own})} recordings"
        yield f"{'':40}" + "".join(f"{name:>12}{'ratio':>8}" for name in names)
        for label in dict.fromkeys(itertools.chain(*found)):
            values = [each.get(label, math.nan) for each in found]
            ratios = [f"{v / values[0]:.2f}" if values[0] else "" for v in values]
            cells = (f"{v:12.3g}{r:>8}" for v, r in zip(values, ratios, strict=True))
            yield f"{label:40}" + "".join(cells)


def rows(base: Path, arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Makes each case in a folder, and yields a row for each method."""
    for seed, which in itertools.product(arguments.seeds.split(","), SETS):
        found = make_case(folder := base / f"{which}-{seed}", which, int(seed), arguments.seconds)
        for method in arguments.methods.split(","):
            row = measure(folder, method, found)
            print(f"{which} {seed} {method}: {row['message'] or row['cpu_seconds']}", flush=True)
            yield {"seed": int(seed), "set": which, "method": method, **row}


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="npdr_ppl beside mujoco.sysid.")
    parser.add_argument("--seeds", default="0", help="seeds of recordings, by commas")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each rollout")
    parser.add_argument("--methods", default="sysid,sysid-rk4,closest", help=", ".join(METHODS))
    parser.add_argument("--out", type=Path, default=Path("sysid.jsonl"))
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    parser.add_argument("--one", nargs=2, metavar=("METHOD", "FOLDER"), help="only fit a case")
    arguments = parser.parse_args()
    if arguments.one:
        method, folder = arguments.one
        Path(folder, f"{method}.json").write_text(json.dumps(FITS[method](Path(folder))))
        return
    if not arguments.summary:
        with tempfile.TemporaryDirectory() as base, arguments.out.open("a") as file:
            for row in rows(Path(base), arguments):
                print(json.dumps(row), file=file, flush=True)
    lines = (arguments.summary or arguments.out).read_text().splitlines()
    print("\n".join(table([json.loads(line) for line in lines])))


if __name__ == "__main__":
    main()
