"""Returns of trained policies on hidden rigs in MuJoCo, and what each part of the loop is worth.

    python benchmarks/policy_loop.py --out study                     # the table
    python benchmarks/policy_loop.py --out study --ablation          # the ablation
    python benchmarks/policy_loop.py --out study --discover          # what discovery is worth
    python benchmarks/policy_loop.py --out study --rigs furuta-random-100 --seeds 2

Rigs hide their parameters and effects. Each method gets at most five real rollouts; a run is
judged by fresh episodes of its last policy. With --discover there are two real rollouts, and the
loop starts from the paper's equations, with and without discovery. Rollouts of one policy are
nearly identical, so runs (rig and seed) are counted. What the folder holds is not run again, so a
killed study continues.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch

from npdr_ppl.loop.loop_options import LOOP_DATA, LoopOptions
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.reproduction.rig_study import METHODS, study, summarise

SUCCESS = 1_400.0

HARD = ("furuta-hard",)
RANDOM = tuple(f"furuta-random-{seed}" for seed in range(10))

ABLATION = {
    "as it is": {},
    "recorded initial states": {"data.initial_state": "recorded"},
    "decisions logged only": {"follows_decisions": False},
    "point estimate": {"domains": "most likely", "spread": 0.0, "num_domains": 1},
    "point estimate ± 10 %": {"domains": "most likely", "spread": 0.1},
    "posterior": {"spread": 0.0},
    "posterior ± 10 %": {"spread": 0.1},
    "posterior ± 20 %": {"spread": 0.2},
    "nominal controller": {"internal_model": "nominal"},
    "latest rollout only": {"rollouts_used": "latest"},
    "started from the last posterior": {"start": "posterior"},
}
"""Changes of the loop's options; ``data.`` begins those that prepare rollouts."""

DISCOVER = {
    "iterations": 2,
    "rounds": 1,
    "num_simulations": 2_000,
    "search": "cma-es",
    "search_iterations": 60,
    "num_domains": 30,
    "num_initial_states": 2,
    "starts_from_prior": False,
}
"""Two real rollouts, the first of the default gains: a policy trained on the prior knocks the arm
of most rigs against its stop within a second, which leaves too little to tell effects by. With
half as many iterations of the search, policies balance in simulation and fail on some rigs."""

COMPARED = "npdr with discovery,npdr"


def changed(loop: LoopOptions, changes: dict) -> tuple[LoopOptions, DataOptions]:
    """Returns the loop's options with some changed, and how it prepares rollouts."""
    data = {n.removeprefix("data."): v for n, v in changes.items() if n.startswith("data.")}
    own = {name: value for name, value in changes.items() if not name.startswith("data.")}
    return replace(loop, **own), replace(LOOP_DATA, **data)


def main() -> None:
    """Runs the study that the arguments choose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", default="", help="all of the table if not given")
    parser.add_argument("--rigs", default="", help="names; both sets of the table if not given")
    parser.add_argument("--seeds", type=int, default=5, help="how many, from 0")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--simulations", type=int, default=5_000, help="of each round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--search-iterations", type=int, default=LoopOptions.search_iterations)
    parser.add_argument("--search", default=LoopOptions.search)
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--discover", action="store_true")
    parser.add_argument("--variants", default="", help="of the ablation; all if not given")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    loop = LoopOptions(
        iterations=arguments.iterations,
        rounds=arguments.rounds,
        num_simulations=arguments.simulations,
        search=arguments.search,
        search_iterations=arguments.search_iterations,
        # Every method trains as often as the others: no check asks for more of it.
        least_success=0.0,
    )
    sets = {"hard": HARD, "random": RANDOM}
    if arguments.rigs:
        sets = {"chosen": tuple(arguments.rigs.split(","))}
    variants = {"": {}}
    if arguments.ablation:
        chosen = arguments.variants.split(",") if arguments.variants else list(ABLATION)
        variants = {name: ABLATION[name] for name in chosen}
    every = [label for label, method in METHODS.items() if not method.discovers]
    methods = arguments.methods.split(",") if arguments.methods else every
    if arguments.ablation:
        methods = ["npdr with effects"]
    if arguments.discover:
        loop, _ = changed(loop, DISCOVER)
        methods = (arguments.methods or COMPARED).split(",")
        sets.pop("hard", None)
    result = {}
    started = time.perf_counter()

    def note(label: str, rig: str, seed: int, outcome) -> None:
        own = sum(outcome.returns) / len(outcome.returns)
        real = " ".join(f"{record['real_return']:.0f}" for record in outcome.iterations)
        effects = outcome.iterations[-1].get("effects", []) if outcome.iterations else []
        seconds = time.perf_counter() - started
        print(f"{seconds:6.0f} s  {label:27} {rig:18} {seed:3}  {own:6.0f}  ({real})", flush=True)
        if effects:
            print(f"{'':10}{', '.join(effects)}", flush=True)

    for variant, changes in variants.items():
        chosen_loop, options = changed(loop, changes)
        folder = arguments.out / variant.replace(" ", "_").replace("%", "percent")
        for name, rigs in sets.items():
            found = study(
                methods,
                rigs,
                seeds,
                chosen_loop,
                folder,
                options=options,
                progress=False,
                note=note,
            )
            for label, outcomes in found.items():
                row = summarise(outcomes, SUCCESS)
                result.setdefault(variant or label, {})[name] = row
                rig = row["return_rig"]
                print(
                    f"{variant or label:32} {name:7} {rig['mean']:6.0f} ± {rig['std']:4.0f}  "
                    f"success {row['success']:4.0%} of {row['runs']}  "
                    f"nominal simulator {row['return_sim']['mean']:6.0f}",
                    flush=True,
                )
    (arguments.out / "study.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
