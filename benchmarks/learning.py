"""Learned laws on hidden rigs: how much of the gap they close, how close they are to the truth.

    python benchmarks/learning.py --conditions outside --num-seeds 3 --out outside.jsonl
    python benchmarks/learning.py --conditions without --separations 30 --out without.jsonl
    python benchmarks/learning.py --conditions null,one --separations 10 --out offered.jsonl
    python benchmarks/learning.py --summary outside.jsonl

The rigs and their recordings are those of :mod:`discovery`. Settings are chosen with
``--part tune``, whose seeds are not those that are reported. The misfit on the other excitation is
the mean over several recordings, because noise changes that of one by 5 %. The floor is this mean
for the same rig with nothing hidden. With ``--whole``, a row is the result of
``npdr discover --learn``; without it, laws are learned from the fitted original model.
"""

import argparse
import json
import statistics
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from discovery import SEEDS, Task, _case, _catalogue, tasks
from hidden_rigs import RIGS, Case, hold_out_again, make_case
from hidden_rigs.force_laws import FORCE_LAWS
from hidden_rigs.friction_laws import DRY_LAWS
from learning_rivals import rival_models

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.curves import law_along
from npdr_ppl.discovery.learning.learn import LearnedModel, learned_model
from npdr_ppl.discovery.learning.proof import checks, misfit
from npdr_ppl.discovery.learning.recorded_motion import motion_at_ports
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.segment_options import segment_options, short_segments
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel

NUM_ELSEWHERE = 4
"""Recordings of the other excitation whose misfits are averaged."""


def judge(task: Task, is_whole: bool) -> dict[str, Any]:
    """Makes a case, learns, and returns the row."""
    torch.set_num_threads(1)
    row: dict[str, Any] = asdict(task)
    try:
        case, strength, separation = _case(task)
        truth = [f"{h.name} {dict(h.parameters)}" for h in case.truth]
        row |= {"strength": strength, "d": separation, "truth": truth}
        begin = time.process_time()
        short = short_segments(case.fit)
        searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(), data_options=short)
        start = searcher.settled(searcher.fit_base(may_be_rough=True))
        if is_whole:
            search = npdr.DiscoveryOptions(effects=_catalogue(task, case), learn=True)
            found = npdr.discover(
                case.model, case.fit, holdout=case.holdout, search=search, seed=task.seed
            )
            row |= {"verdict": found.verdict, "reason": found.reason}
            row["effects"] = [f.effect.name for f in found.effects]
            learned = found.learned and found.learned.model
            row["offered"] = bool(found.learned and found.learned.is_offered)
        else:
            learned = learned_model(searcher.trials, start)
        row["cpu"] = time.process_time() - begin
        if learned is not None:
            row |= _described(case, learned)
    except Exception as error:  # a failure is a row with its message
        row["error"] = f"{type(error).__name__}: {error}"[:300]
    return row


def _described(case: Case, learned: LearnedModel) -> dict[str, Any]:
    same = DataOptions(segment_length=learned.start.segments.inputs.num_steps)
    null = make_case(case.rig, "null", (), seed=case.seed)
    searcher = Searcher(null.model, null.fit, npdr.DiscoveryOptions(), data_options=same)
    quiet = searcher.settled(searcher.fit_base(may_be_rough=True))
    models = {"before": learned.start, "after": learned.hypothesis}
    models |= rival_models(learned.start, case.fit)
    misfits = {name: _misfit_elsewhere(h, case, quiet) for name, h in models.items()}
    before, after = misfits.pop("before"), misfits.pop("after")
    floor = _misfit_elsewhere(quiet, null, quiet)
    return {
        "laws": [f"{law.port.name}: {law.formula_with_numbers}" for law in learned.laws],
        "before": before,
        "after": after,
        "floor": floor,
        "closed": (before - after) / (before - floor),
        "checks": [
            c.to_dict() for c in checks(learned, case.holdout, segment_options(case.holdout, same))
        ],
        "rivals": misfits,
        "force_error": _force_error(case, learned),
        "closed_on_fit": _closed_on_fit(learned, quiet),
    }


def _misfit_elsewhere(hypothesis: Hypothesis, case: Case, quiet: Hypothesis) -> float:
    """Returns a model's mean misfit along recordings of the other excitation."""
    same = DataOptions(segment_length=hypothesis.segments.inputs.num_steps)
    found = []
    for number in range(NUM_ELSEWHERE):
        recorded = hold_out_again(case, seed=100 * case.seed + number)
        along = SegmentModel(hypothesis.model, recorded, segment_options(recorded, same))
        found.append(misfit(hypothesis, along, quiet.fit.scale))
    return statistics.fmean(found)


def _closed_on_fit(learned: LearnedModel, quiet: Hypothesis) -> float:
    scale = quiet.fit.scale
    before, after, floor = (
        float(h.losses(scale).sum()) for h in (learned.start, learned.hypothesis, quiet)
    )
    return (before - after) / (before - floor)


def _force_error(case: Case, learned: LearnedModel) -> float | None:
    """Returns the RMSE of the learned force relative to the true one, along the recording.

    ``None`` where the truth is no function of position, velocity and time at a joint, or the law
    is at another port.
    """
    (hidden,), laws = case.truth, {law.port.name: law for law in learned.laws}
    if hidden.port not in laws or hidden.effect_id not in {**FORCE_LAWS, **DRY_LAWS}:
        return None
    motion = next(m for m in motion_at_ports(learned.start) if m.port.name == hidden.port)
    found = law_along(laws[hidden.port], motion)
    x = {name: value.numpy() for name, value in motion.values.items()}
    p = hidden.parameters
    if hidden.effect_id in FORCE_LAWS:
        true = torch.as_tensor(FORCE_LAWS[hidden.effect_id](p, x["q"], x["v"], x["t"]))
    else:
        side = motion.values["v"].sign()
        bound = DRY_LAWS[hidden.effect_id](
            p, side.numpy(), x["q"], x["v"], x.get("tau", 0.0 * x["q"])
        )
        true = -torch.as_tensor(bound) * side
    return float((found - true).square().mean().sqrt() / true.square().mean().sqrt())


def summarise(rows: list[dict[str, Any]]) -> None:
    """Prints the shares."""
    for condition in sorted({row["condition"] for row in rows}):
        own = [row for row in rows if row["condition"] == condition]
        bad = [row for row in own if "error" in row]
        made = [row for row in own if "error" not in row]
        closed = [row.get("closed", 0.0) for row in made]
        forces = [row["force_error"] for row in made if row.get("force_error") is not None]
        print(f"{condition}: {len(made)} cases, {len(bad)} could not be made or failed")
        if not made:
            continue
        print(f"  gap closed: median {statistics.median(closed):.0%}, at least 80 %:", end=" ")
        print(f"{sum(c >= 0.8 for c in closed)} of {len(closed)}")
        if forces:
            print(f"  error of the force: median {statistics.median(forces):.1%} of {len(forces)}")
        worse = [r for r in made if r.get("after", 0.0) > r.get("before", 0.0)]
        print(f"  worse than before on the other excitation: {len(worse)}")
        for rival in ("pysindy", "gp"):
            own = [r for r in made if rival in r.get("rivals", {})]
            better = sum(r["after"] < r["rivals"][rival] for r in own)
            print(f"  lower misfit on the other excitation than {rival}: {better} of {len(own)}")
        offered = [r for r in made if r.get("offered")]
        if any("offered" in r for r in made):
            print(f"  offered: {len(offered)}; of these worse: {sum(r in worse for r in offered)}")
        print(f"  CPU s: median {statistics.median([r['cpu'] for r in made]):.0f}")


def main() -> None:
    """Runs the cases, or prints the summary of a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--summary", type=Path)
    parser.add_argument("--conditions", default="outside")
    parser.add_argument("--rigs", default="pendulum,emps,cart_pole")
    parser.add_argument("--separations", default="30")
    parser.add_argument("--part", default="test", choices=SEEDS)
    parser.add_argument("--first-seed", type=int, default=60)
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--whole", action="store_true")
    options = parser.parse_args()
    if options.summary:
        summarise([json.loads(line) for line in options.summary.read_text().splitlines()])
        return
    if options.out is None:
        parser.error("--out FILE or --summary FILE is needed")
    seeds = [SEEDS[options.part][options.first_seed + k] for k in range(options.num_seeds)]
    rigs = [name for name in options.rigs.split(",") if name in RIGS]
    wanted = [float(d) for d in options.separations.split(",")]
    every = list(tasks(options.conditions.split(","), rigs, seeds, wanted))
    known = options.out.read_text().splitlines() if options.out.exists() else []
    done = {_key(json.loads(line)) for line in known}
    left = [task for task in every if _key(asdict(task)) not in done]
    with ProcessPoolExecutor(options.workers) as pool, options.out.open("a") as out:
        waiting = [pool.submit(judge, task, options.whole) for task in left]
        for future in as_completed(waiting):
            row = future.result()
            out.write(json.dumps(row) + "\n")
            out.flush()
            short = {k: row.get(k) for k in ("rig", "truth", "laws", "closed", "force_error")}
            print(short | {"error": row.get("error")}, flush=True)


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("rig", "condition", "place", "separation", "seed"))


if __name__ == "__main__":
    main()
