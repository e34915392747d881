"""Calibrates one round of snpe-c on the Furuta pendulum, along a real recording's inputs.

    python benchmarks/calibration.py --data swing_up_500hz_5s.csv --out result.json
    python benchmarks/calibration.py --data swing_up_500hz_5s.csv --variants default,members-5

Rollouts 0 and 1 give the actions and the states at which segments of 200 steps start; everything
else is simulated. The readings' noise is chosen, not measured: 10 and 20 mrad on the angles, a few
counts of the recording's encoders, and what numerical differentiation makes of it on the
velocities. Targets: highest-density coverage within 5 points of nominal at 50, 80 and 95 %, and
ranks of all parameters uniform at 1 % (Bonferroni).
"""

import argparse
import json
import logging
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.furuta import furuta

NOISE = {"arm_angle": 0.01, "pole_angle": 0.02, "arm_velocity": 0.3, "pole_velocity": 0.5}
"""Standard deviations in rad and rad/s."""

TOLERANCE = 0.05

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "members-1": {"members": 1},
    "members-2": {"members": 2},
    "members-5": {"members": 5},
    "members-8": {"members": 8},
    "decay": {"weight_decay": 0.1},
    "narrow": {"hidden": (64, 64)},
    "one-spline": {"transforms": 2},
    "affine": {"flow": "maf", "transforms": 4},
    "slow": {"learning_rate": 3e-3},
    "short": {"epochs": 15},
}
"""Options of the backend by name of the variant."""


def measure(arguments: argparse.Namespace, variant: str) -> dict[str, Any]:
    """Infers once and calibrates."""
    rollouts = npdr.Rollouts.from_csv(arguments.data)[[0, 1]]
    started = time.process_time()
    posterior = npdr.infer(
        partial(furuta, noise=NOISE),
        rollouts,
        backend=backend("snpe-c", **VARIANTS[variant]),
        num_simulations=arguments.simulations,
        options=npdr.DataOptions(
            embedding=arguments.embedding,
            segment_length=200,
            initial_state="recorded",
            precision="float32",
        ),
        seed=arguments.seed,
        progress=False,
    )
    inferred = time.process_time()
    found = npdr.calibrate(
        posterior,
        num_datasets=arguments.datasets,
        num_draws=arguments.draws,
        seed=arguments.seed + 1,
        progress=False,
    )
    ended = time.process_time()
    ranks = {name: found.p_values[name] for name in found.parameters}
    coverage = found.coverage()
    return {
        "variant": variant,
        "options": VARIANTS[variant],
        "simulations": arguments.simulations,
        "embedding": arguments.embedding,
        "validation_log_prob": posterior.provenance.rounds[0].losses["validation_log_prob"],
        "coverage_within_tolerance": all(
            abs(c.expected - c.nominal) <= TOLERANCE for c in coverage
        ),
        "ranks_pass": min(ranks.values()) * len(ranks) >= 0.01,
        "cpu_seconds": {"infer": inferred - started, "calibrate": ended - inferred},
        **found.to_dict(),
    }


def main() -> None:
    """Runs the variants that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="the recording, a CSV file")
    parser.add_argument("--variants", default="default", help=", ".join(VARIANTS))
    parser.add_argument("--simulations", type=int, default=20_000)
    parser.add_argument("--embedding", default="all/50")
    parser.add_argument("--datasets", type=int, default=300)
    parser.add_argument("--draws", type=int, default=999)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("npdr_ppl").setLevel(logging.ERROR)
    print(
        f"{'variant':14} {'at 50 %':>8} {'at 80 %':>8} {'at 95 %':>8} {'p density':>10} "
        f"{'p ranks':>8} {'p TARP':>8} {'log q':>7} {'infer s':>8} {'cal. s':>7}"
    )
    rows = []
    for variant in arguments.variants.split(","):
        row = measure(arguments, variant)
        rows.append(row)
        shown = [c["expected"] for c in row["coverage"]["highest_density"]]
        p = row["p_values"]
        least = min(value for name, value in p.items() if name not in ("highest_density", "tarp"))
        log_q = sum(row["validation_log_prob"]) / len(row["validation_log_prob"])
        print(
            f"{variant:14} {shown[0]:8.3f} {shown[1]:8.3f} {shown[2]:8.3f} "
            f"{p['highest_density']:10.2g} {least:8.2g} {p['tarp']:8.2g} {log_q:7.2f} "
            f"{row['cpu_seconds']['infer']:8.0f} {row['cpu_seconds']['calibrate']:7.0f}",
            flush=True,
        )
        if arguments.out:
            arguments.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
