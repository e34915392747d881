"""Which features keep what a recording says: posteriors of SNPE-C from each, before correction.

    python benchmarks/features.py --seeds 2 --out features.jsonl
    python benchmarks/features.py --summary --out features.jsonl

Clean recordings of every model of the zoo are prepared as every command does, and a posterior is
learnt from each kind of features with the same 1000 simulations, of parameters from around the
closest fit: a normal density five times as wide as Laplace's approximation there. The better the
features, the narrower is what is learnt; its standard deviations are divided by those of that
approximation. Only directions of which the recording says much are drawn and compared: along the
others the approximation does not hold. Seeds are those of tuning in :mod:`clean_fits`.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

# The copy of the package beside this file is judged, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch  # noqa: E402
from clean_fits_rigs import RIG_SUBJECTS  # noqa: E402
from clean_fits_subjects import HOLDOUT, recorded  # noqa: E402

import npdr_ppl as npdr  # noqa: E402
from npdr_ppl.cli.resolve import resolve_model  # noqa: E402
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture  # noqa: E402
from npdr_ppl.posterior.prepare import Preparation, prepare  # noqa: E402
from npdr_ppl.preparation.data_options import DataOptions

FEATURES = ("score", "all/10", "all~10", "bayessim", "gru/10")

TIMES_AS_WIDE = 5.0
"""How many times as wide as Laplace's approximation the density is that parameters are drawn
from: enough for useless features to show, near enough for 1000 simulations to resolve."""

WIDEST = 0.1
"""Largest standard deviation of that density in any direction, in the prior's."""


def judge(prepared: Preparation, features: str, seed: int) -> dict[str, Any]:
    """Learns a posterior from features and returns its figures."""
    assert prepared.likelihood is not None
    started = time.process_time()
    information = prepared.likelihood.information()
    precisions, directions = torch.linalg.eigh(information + torch.eye(len(information)))
    deviations = precisions.rsqrt()
    around = (TIMES_AS_WIDE * deviations).clamp_max(WIDEST)
    covariance = directions * around.square() @ directions.mT
    one, centre = torch.ones(1, dtype=torch.float64), prepared.likelihood.fit.z[None]
    posterior = npdr.infer(
        prepared.plain_model,
        prepared.rollouts,
        preparation=prepared.with_features(features),
        seed=seed,
        start=GaussianMixture.from_moments(one, centre, covariance[None]),
        corrects=False,
        progress=False,
    )
    draws = posterior.sample_reference(2_000, seed=seed).double().flatten(0, -2) @ directions
    ratio = (draws.std(0) / deviations)[TIMES_AS_WIDE * deviations <= WIDEST]
    return {
        "directions": len(ratio),
        "times_as_wide": float(ratio.log().mean().exp()),
        "cpu_seconds": time.process_time() - started,
    }


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--subjects", default=",".join(RIG_SUBJECTS))
    parser.add_argument("--features", default=",".join(FEATURES))
    parser.add_argument("--out", type=Path, default=Path("features.jsonl"))
    parser.add_argument("--summary", action="store_true", help="only print what the file says")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    if arguments.out.exists():
        rows = [json.loads(line) for line in arguments.out.read_text().splitlines()]
    done = {(row["subject"], row["seed"], row["features"]) for row in rows}
    seeds = () if arguments.summary else range(arguments.seeds)
    for seed in seeds:
        for subject in arguments.subjects.split(","):
            left = [
                word for word in arguments.features.split(",") if (subject, seed, word) not in done
            ]
            if not left:
                continue
            recording = recorded(subject, seed)
            assert recording.rollouts is not None
            options = DataOptions("score", "auto", "uncertain", "float64")
            prepared = prepare(
                resolve_model(recording.model), recording.rollouts[:HOLDOUT], options, seed=seed
            )
            for word in left:
                row = {"subject": subject, "seed": seed, "features": word}
                row |= judge(prepared, word, seed)
                rows.append(row)
                with arguments.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                print(row, flush=True)
    print_summary(rows)


def print_summary(rows: list[dict[str, Any]]) -> None:
    """Prints the median width and CPU seconds, by model and features."""
    subjects = list(dict.fromkeys(row["subject"] for row in rows))
    print("| features | " + " | ".join(subjects) + " | CPU s |")
    print("|---|" + "---|" * (len(subjects) + 1))
    for word in dict.fromkeys(row["features"] for row in rows):
        own = [row for row in rows if row["features"] == word]
        widths = []
        for subject in subjects:
            found = [row["times_as_wide"] for row in own if row["subject"] == subject]
            widths.append(f"{statistics.median(found):.1f}" if found else "–")
        seconds = statistics.median(row["cpu_seconds"] for row in own)
        print(f"| `{word}` | {' | '.join(widths)} | {seconds:.0f} |")


if __name__ == "__main__":
    main()
