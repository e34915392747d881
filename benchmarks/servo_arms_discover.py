"""Discovers with all defaults what the model in a folder is missing, as a user's program would.

    python benchmarks/servo_arms_discover.py FOLDER --seed 0

FOLDER holds what a case of :mod:`servo_arms_cases` wrote; ``discovery.json`` goes to
``FOLDER/discovery``.
"""

import argparse
from pathlib import Path

from servo_arms_rigs import FIT, HOLDOUT

import npdr_ppl as npdr
from npdr_ppl.cli.resolve import resolve_model


def main() -> None:
    """Runs the discovery and writes its result."""
    parser = argparse.ArgumentParser(description="Discovers with all defaults.")
    parser.add_argument("folder", type=Path, help="where model and recording are")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    rollouts = npdr.Rollouts.from_npz(folder / "rec.npz")
    found = npdr.discover(
        resolve_model(f"{folder / 'arm_model.py'}:model"),
        rollouts[list(FIT)],
        holdout=rollouts[list(HOLDOUT)],
        seed=arguments.seed,
    )
    found.save(folder / "discovery")


if __name__ == "__main__":
    main()
