"""A fit with crashes, hangs and NaN injected, against the same fit without.

    python benchmarks/faults.py                          # a pendulum in Bullet, some minutes
    python benchmarks/faults.py --times 2                # faults that a retry does not cure
    python benchmarks/faults.py --executor dask          # or ray, with their own clusters
    python benchmarks/faults.py --model file.py:model --data measured.csv
    python benchmarks/faults.py --strike strike_100hz_8s.csv     # mini golf, about ten minutes

Faults are real: processes exit or segfault, sleep, sit in native code or wait for a program that
they have started, and trajectories are NaN.
Three fits are made: clean, clean with another seed (the yardstick of Monte-Carlo error), and
faulty. The exit code is 1 if a draw is lost that was not to be, if the counts are not those of the
rates, if a program is left running, or if the faulty posterior's moments are further from the
clean one's than ``--tolerance`` times the yardstick (floored at 5 % of a standard deviation).
"""

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

import npdr_ppl as npdr
from npdr_ppl.cli.resolve import resolve_model
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.mini_golf import mini_golf
from npdr_ppl.reproduction import mini_golf_fit
from npdr_ppl.rollouts import Rollouts

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.helpers.bullet_models import PendulumModel, pendulum_urdf  # noqa: E402
from tests.helpers.faulty import FaultRates, num_programs  # noqa: E402
from tests.helpers.faulty_simulator import FaultMessenger  # noqa: E402

FLOOR = 0.05
"""Share of a posterior standard deviation below which a difference is of no interest."""

FALSE_ALARM = 4.0
"""Binomial standard deviations that a count may be off: 6e-5 per count."""


def bullet_pendulum(folder: Path) -> tuple[Callable[..., Any], Rollouts]:
    """Returns a model of a pendulum in Bullet and a noisy recording of it."""
    model = PendulumModel(pendulum_urdf(folder))
    times = 0.02 * torch.arange(100, dtype=torch.float64)
    inputs = Inputs.single(
        (4.0 * torch.sin(5.0 * times))[:, None],
        torch.tensor([0.2, 0.0]).double(),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.02,
    )
    true = {"mass": torch.tensor(1.1).double(), "damping": torch.tensor(0.15).double()}
    after = model.simulator.simulate(true, inputs)[0]
    readings = torch.cat((inputs.initial_values, after))
    noise = torch.randn(readings.shape, generator=torch.Generator().manual_seed(3))
    readings = readings + noise * torch.tensor([0.02, 0.1])
    rollouts = Rollouts.from_arrays(
        readings=[readings.numpy()],
        actions=[inputs.actions[0].numpy()],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    )
    return npdr.with_noise(model, {"angle": 0.02, "velocity": 0.1}), rollouts


def mini_golf_strike(file: Path) -> tuple[Callable[..., Any], Rollouts]:
    """Returns the mini-golf model and its first recorded strike, as Table 1 is fitted to it."""
    return partial(mini_golf, noise=mini_golf_fit.NOISE), Rollouts.load(file)[[0]]


def moments(posterior: npdr.Posterior) -> dict[str, tuple[float, float]]:
    """Returns mean and standard deviation of every parameter."""
    draws = posterior.sample(4_000, seed=0)
    return {name: (float(x.double().mean()), float(x.double().std())) for name, x in draws.items()}


def difference(
    one: dict[str, tuple[float, float]], other: dict[str, tuple[float, float]]
) -> float:
    """Returns the greatest difference of moments, in standard deviations of the first."""
    return max(
        max(abs(one[name][0] - other[name][0]) / one[name][1],
            abs(math.log(one[name][1] / other[name][1])))
        for name in one
    )  # fmt: skip


def main() -> None:
    """Fits three times, prints and judges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", help="Zoo name, or path/to/file.py:function.")
    parser.add_argument("--data", type=Path, help="Rollouts of the model.")
    parser.add_argument("--strike", type=Path, help="Recorded strikes of mini golf.")
    parser.add_argument("--simulations", type=int, default=5_000)
    parser.add_argument("--backend", default="snpe-c")
    parser.add_argument("--embedding", help="all/10; for --strike that of Table 1.")
    parser.add_argument("--segment-length", type=int)
    parser.add_argument("--initial-state", help="estimated; for --strike recorded.")
    parser.add_argument("--crash", type=float, default=0.01)
    parser.add_argument("--hang", type=float, default=0.01)
    parser.add_argument("--nan", type=float, default=0.03)
    parser.add_argument("--times", type=int, default=1, help="Attempts that fail in a row.")
    parser.add_argument("--executor", default="loky")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--time-limit", type=float, default=1.0)
    parser.add_argument("--tolerance", type=float, default=3.0)
    parser.add_argument("--out", type=Path, help="JSON file to write.")
    options = parser.parse_args()
    torch.set_num_threads(1)
    programs_before = num_programs()
    rates = FaultRates(options.crash, options.hang, options.nan, options.times)
    with (
        tempfile.TemporaryDirectory() as folder,
        npdr.workers(options.executor, options.workers, time_limit=options.time_limit),
    ):
        if options.strike is not None:
            model, rollouts = mini_golf_strike(options.strike)
        elif options.model is None:
            model, rollouts = bullet_pendulum(Path(folder))
        else:
            model, rollouts = resolve_model(options.model), Rollouts.load(options.data)
        embedding, start = (
            (mini_golf_fit.EMBEDDING, "recorded") if options.strike else ("all/10", "estimated")
        )
        embedding, start = options.embedding or embedding, options.initial_state or start
        log = Path(folder) / "faults"
        log.mkdir()

        def fit(chosen: Callable[..., Any], seed: int) -> tuple[npdr.Posterior, float]:
            started = time.perf_counter()
            posterior = npdr.infer(
                chosen,
                rollouts,
                backend=backend(options.backend),
                num_simulations=options.simulations,
                options=npdr.DataOptions(
                    embedding=embedding, segment_length=options.segment_length, initial_state=start
                ),
                seed=seed,
                progress=False,
            )
            return posterior, time.perf_counter() - started

        clean, clean_seconds = fit(model, 0)
        other, _ = fit(model, 1)
        faulty, faulty_seconds = fit(FaultMessenger(rates, log)(model), 0)
    programs_left = num_programs() - programs_before
    counts = faulty.provenance.faults
    yardstick = difference(moments(clean), moments(other))
    found = difference(moments(clean), moments(faulty))
    result = {
        "executor": options.executor,
        "counts": counts,
        "programs_left": programs_left,
        "moments": {"clean": moments(clean), "other": moments(other), "faulty": moments(faulty)},
        "difference": {"clean seeds": yardstick, "faulty": found},
        "seconds": {"clean": clean_seconds, "faulty": faulty_seconds},
    }
    print(json.dumps(result, indent=2))
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=2) + "\n")
    problems = judge(counts, rates, found, options.tolerance * max(yardstick, FLOOR))
    if programs_left:
        problems.append(f"{programs_left} programs were left running")
    if problems:
        raise SystemExit("; ".join(problems))


def judge(counts: dict[str, int], rates: FaultRates, found: float, limit: float) -> list[str]:
    """Returns what is wrong."""
    problems = []
    draws = counts["draws"]
    attempts = min(rates.times, 2)
    for kind, rate in (("crashed", rates.crash), ("hung", rates.hang), ("nan", rates.nan)):
        number = counts[kind] / attempts
        if abs(number - draws * rate) > FALSE_ALARM * math.sqrt(draws * rate * (1 - rate)):
            problems.append(f"{kind}: {counts[kind]} of {draws} draws at a rate of {rate:.1%}")
    failed = (counts["crashed"] + counts["hung"] + counts["nan"]) / attempts
    if counts["retried"] != failed or counts["lost"] != (failed if rates.times > 1 else 0):
        problems.append(f"{counts['retried']} retried and {counts['lost']} lost of {failed:.0f}")
    if found > limit:
        problems.append(f"the posterior's moments are {found:.2f} standard deviations off")
    return problems


if __name__ == "__main__":
    main()
