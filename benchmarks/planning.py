"""Ambiguous recordings of hidden rigs: does one planned recording tell the causes apart?

    python benchmarks/planning.py --num 60 --out planning.jsonl
    python benchmarks/planning.py --summary planning.jsonl

A case begins with the first half of one rollout of a rig of :mod:`hidden_rigs`, with one effect
hidden. There are two kinds. With ``--cases weak``, the strength is a part of the rig's typical
size, down to a twentieth. With ``--cases gentle``, the effect has its typical size, and commands
and pose of the first recording are a part of the usual ones, down to a tenth. A case counts if
the verdict of ``discover`` is ``ambiguous``, the hidden effect is among the causes that are left,
and so is one that a recording of the rig can tell from it. Then one recording is planned, with as
many rollouts as :func:`npdr_ppl.planning.plan_recording` chooses, and played on the rig.
``discover`` gets it with the first one. The same is done with as many random rollouts within the
same limits: the first random excitations of the search that keep them. The limits are the rig's
greatest commands, twice the positions and speeds of its usual recordings, twice the length of the
first one and three times its bandwidth, and any pose from which the rig's rollouts are let go.

Told apart means that no such cause is left: the verdict names the hidden effect or what no
recording tells from it, or only these are left. A case is undecidable if the plan itself predicts
a chance below a half. Rows are written as they come, and a run given again continues. Numbers
below 100 are for tuning.
"""

import argparse
import itertools
import json
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from discovery_rows import has_all, right_sets
from hidden_rigs import RIGS, Case, make_case, places, play

import npdr_ppl as npdr
from npdr_ppl.planning import Plan, plan_recording
from npdr_ppl.planning.causes import Known, causes_of_run
from npdr_ppl.planning.limits import ActionLimits, Limits, default_limits
from npdr_ppl.rollouts import Rollouts

FIRST_SEED = 2000
"""Seed of the first cases; those of the blind benchmark end before it."""

FIRST_SHARE = 0.5
"""Share of a rollout that is recorded first: short recordings are ambiguous more often."""

TIMES_RANGE, TIMES_BAND = 2.0, 3.0
"""Limits as multiples of the positions and velocities of the rig's usual recordings, and of its
bandwidth."""

UNDECIDABLE = 0.5
"""Predicted chance of the right name below which a case cannot be decided within the limits."""

NAMED = 0.05
"""Probability from which a cause is left, as in the verdict."""

STRENGTHS = (0.05, 0.1, 0.2, 0.4)
"""Multiples of an effect's typical size, drawn for each weak case: weak effects are ambiguous more
often."""

AMPLITUDES = (0.1, 0.2, 0.4)
"""Shares of the usual commands and poses, drawn for each gentle case."""


@dataclass(frozen=True)
class Task:
    """One case to be planned for.

    Attributes:
        rig: Name of the rig.
        place: Index of the hidden effect among the rig's.
        strength: Multiple of its typical size.
        seed: The case's seed.
        amplitude: Commands and pose of the first recording, as a share of the usual ones.
    """

    rig: str
    place: int
    strength: float
    seed: int
    amplitude: float = 1.0


def tasks(rigs: list[str], first: int, kind: str) -> Iterator[Task]:
    """Yields cases without end: rigs and effects in random order, then those of other seeds."""
    for number in itertools.count(first):
        seed = FIRST_SEED + number
        places_of = [(rig, place) for rig in rigs for place in range(len(places(rig, "one")))]
        generator = np.random.default_rng(seed)
        for index in generator.permutation(len(places_of)):
            rig, place = places_of[index]
            if kind == "weak":
                yield Task(rig, place, float(generator.choice(STRENGTHS)), seed)
            else:
                yield Task(rig, place, 1.0, seed, float(generator.choice(AMPLITUDES)))


def judge(task: Task, rounds: int) -> dict[str, Any]:
    """Records a case, plans if it is ambiguous, and returns the row."""
    row: dict[str, Any] = asdict(task)
    chosen = places(task.rig, "one")[task.place]
    begin = time.monotonic()
    try:
        case = make_case(task.rig, "one", chosen, strength=task.strength, seed=task.seed)
        if RIGS[task.rig].rests_anywhere:
            # What recordings from rest cannot tell apart, none of its recordings can.
            same = RIGS[task.rig].inseparable.get(chosen[0], ())
            names = (tuple(f"{port}.{effect}" for port, effect in group) for group in same)
            case = replace(case, alternatives=(*case.alternatives, *names))
        row |= {"truth": list(case.names), "alternatives": [list(a) for a in case.alternatives]}
        first = _first(case, task)
        found = npdr.discover(case.model, first, seed=task.seed, progress=False)
        row |= {"verdict": found.verdict, "found": _names(found)}
        row |= {"discover_seconds": time.monotonic() - begin}
        if found.verdict == "ambiguous":
            row |= _planned(case, first, found, task, rounds)
    except npdr.NpdrError as error:  # a failure is a row with its message
        row["error"] = f"{type(error).__name__}: {error}"[:300]
    return row


def _planned(
    case: Case, first: Rollouts, found: npdr.Discovery, task: Task, rounds: int
) -> dict[str, Any]:
    """Returns what a planned and a random recording tell of an ambiguous case."""
    with tempfile.TemporaryDirectory() as folder:
        found.save(Path(folder))
        known = causes_of_run(Path(folder), case.model)
    limits = _limits(case, known)
    begin = time.monotonic()
    plan = plan_recording(known, limits, rounds=rounds, seed=task.seed)
    row: dict[str, Any] = {
        "causes": [cause.name for cause in known.causes],
        "plan": plan.to_dict(),
        "plan_seconds": time.monotonic() - begin,
    }
    for kind, recording in (("planned", plan.recording), ("random", plan.random)):
        recorded = _played(case, recording, 100 * task.seed + 50 * (kind == "random"))
        begin = time.monotonic()
        row[kind] = _told(case, first.concatenate(recorded), task)
        row[kind] |= {"excess": _excess(plan, recorded), "seconds": time.monotonic() - begin}
    return row


def _first(case: Case, task: Task) -> Rollouts:
    """Returns the first half of a rollout, from rest or let go elsewhere in turn."""
    whole = case.fit[[task.place % 2]]
    num = round(FIRST_SHARE * whole.lengths[0])
    first = _like(whole, [whole.readings[0][: num + 1]], [whole.actions[0][:num]])
    if task.amplitude == 1.0:  # a weak case
        return first
    commands, start = first.actions[0], first.readings[0][0]
    return play(case, task.amplitude * commands, task.amplitude * start, seed=100 * task.seed + 99)


def _played(case: Case, planned: Rollouts, seed: int) -> Rollouts:
    """Returns what the rig measures while it plays the rollouts of a plan."""
    played = [
        play(case, commands, readings[0], seed=seed + k)
        for k, (commands, readings) in enumerate(
            zip(planned.actions, planned.readings, strict=True)
        )
    ]
    return played[0].concatenate(*played[1:])


def _like(rollouts: Rollouts, readings: list[Any], actions: list[Any]) -> Rollouts:
    return Rollouts.from_arrays(
        readings,
        actions,
        channel_names=rollouts.channel_names,
        action_names=rollouts.action_names,
        time_step=rollouts.time_step,
        channel_units=rollouts.channel_units,
        action_units=rollouts.action_units,
    )


def _limits(case: Case, known: Known) -> Limits:
    """Returns what a rig may do."""
    rig = RIGS[case.rig]
    found = default_limits(known.causes[0].simulator, known.recorded)
    spread = dict(zip(rig.layout.positions, rig.start_spread, strict=True))
    usual = np.abs(np.concatenate(case.fit.readings)).max(0)
    greatest = {
        name: TIMES_RANGE * max(float(value), spread.get(name, 0.0))
        for name, value in zip(case.fit.channel_names, usual, strict=True)
    }
    channels = {
        name: replace(
            channel,
            min=-greatest[name],
            max=greatest[name],
            start_min=-spread.get(name, 0.0),
            start_max=spread.get(name, 0.0),
        )
        for name, channel in found.channels.items()
    }
    actions = {
        name: ActionLimits(-limit, limit)
        for name, limit in zip(rig.layout.actions, rig.limits, strict=True)
    }
    return replace(
        found,
        duration=rig.duration,
        bandwidth=TIMES_BAND * rig.band.upper,
        actions=actions,
        channels=channels,
    )


def _told(case: Case, rollouts: Rollouts, task: Task) -> dict[str, Any]:
    """Returns the result of a discovery, and whether it names what is hidden."""
    found = npdr.discover(case.model, rollouts, seed=task.seed, progress=False)
    row = {
        "truth": list(case.names),
        "alternatives": [list(a) for a in case.alternatives],
        "effects": [finding.to_dict() for finding in found.effects],
    }
    is_right = found.verdict == "named" and has_all(row)
    if found.verdict == "ambiguous":
        # What is left may be what no recording tells from the hidden effect.
        right = set().union(*right_sets(row))
        left = [
            {n for n, p in f.alternatives.items() if p >= NAMED}
            for f in found.effects
            if f.can_be_named
        ]
        is_right = all(names <= right for names in left)
    return {
        "verdict": found.verdict,
        "found": _names(found),
        "left": [{n: p for n, p in f.alternatives.items() if p >= NAMED} for f in found.effects],
        "is_right": is_right,
        "is_wrong": found.verdict == "named" and not is_right,
        "reason": found.reason,
    }


def _excess(plan: Plan, recorded: Rollouts) -> float:
    """Returns the greatest ratio of a measured value to its limit, less one."""
    worst = -1.0
    every = np.concatenate(recorded.readings)
    for k, channel in enumerate(plan.limits.channels.values()):
        values = every[:, k]
        middle, half = 0.5 * (channel.max + channel.min), 0.5 * (channel.max - channel.min)
        if math.isfinite(half):
            worst = max(worst, float(abs(values - middle).max()) / half - 1.0)
    return worst


def _names(found: npdr.Discovery) -> dict[str, float]:
    return {f.effect.name: f.probability for f in found.effects}


def is_ambiguous(row: dict[str, Any]) -> bool:
    """Returns whether a case counts: the hidden effect and another one are among the causes."""
    if "plan" not in row:
        return False
    left = [set(name.split(" + ")) for name in row["causes"]]
    are_right = [any(right <= names for right in right_sets(row)) for names in left]
    return any(are_right) and not all(are_right)


def is_decidable(row: dict[str, Any]) -> bool:
    """Returns whether the plan itself expects that its recording names the cause."""
    return row["plan"]["outlook"]["chance_of_the_right_name"] >= UNDECIDABLE


def print_summary(path: Path) -> None:
    """Prints how many cases each recording tells apart."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    used = [row for row in rows if is_ambiguous(row) and "random" in row]
    print(f"{len(rows)} cases, {len(used)} ambiguous with the hidden effect among the causes")
    columns = "planned tells apart", "random tells apart", "planned predicts", "random predicts"
    print("| cases | number | " + " | ".join((*columns, "wrong names")) + " |")
    print("|---" * 7 + "|")
    groups = {
        rig: [r for r in used if r["rig"] == rig] for rig in sorted({r["rig"] for r in used})
    }
    groups |= {"all": used, "decidable": [row for row in used if is_decidable(row)]}
    for name, own in groups.items():
        if own:
            told = [_share([r[k]["is_right"] for r in own]) for k in ("planned", "random")]
            predicted = [
                f"{np.mean([r['plan']['outlook'][key] for r in own]):.0%}"
                for key in ("chance_of_the_right_name", "random_chance_of_the_right_name")
            ]
            wrong = ", ".join(
                str(sum(r[k]["is_wrong"] for r in own)) for k in ("planned", "random")
            )
            print("| " + " | ".join((name, str(len(own)), *told, *predicted, wrong)) + " |")
    for key, what in (("plan_seconds", "planning"), ("discover_seconds", "the first discovery")):
        seconds = sorted(row[key] for row in used)
        if seconds:
            print(f"{what}: median {seconds[len(seconds) // 2]:.0f} s, most {seconds[-1]:.0f} s")


def _share(flags: list[bool]) -> str:
    return f"{sum(flags)} ({np.mean(flags):.0%})"


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Planned against random recordings.")
    parser.add_argument("--rigs", default="pendulum,furuta,cart_pole,emps")
    parser.add_argument("--cases", choices=("weak", "gentle"), default="weak")
    parser.add_argument("--num", type=int, default=60, help="ambiguous cases to plan for")
    parser.add_argument("--rounds", type=int, default=30, help="batches of the search")
    parser.add_argument("--first", type=int, default=100, help="number of the first cases")
    parser.add_argument("--most-seconds", type=float, default=math.inf)
    parser.add_argument("--out", type=Path, default=Path("planning.jsonl"))
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    arguments = parser.parse_args()
    if arguments.summary:
        print_summary(arguments.summary)
        return
    torch.set_num_threads(1)
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {Task(**{key: r[key] for key in Task.__annotations__ if key in r}) for r in rows}
    begin, num = time.monotonic(), sum(map(is_ambiguous, rows))
    for task in tasks(arguments.rigs.split(","), arguments.first, arguments.cases):
        if num >= arguments.num or time.monotonic() - begin > arguments.most_seconds:
            break
        if task in done:
            continue
        row = judge(task, arguments.rounds)
        num += is_ambiguous(row)
        with arguments.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        told = {k: row[k]["verdict"] for k in ("planned", "random") if k in row}
        print(task, row.get("truth"), row.get("verdict", row.get("error")), told, flush=True)
    print_summary(arguments.out)


if __name__ == "__main__":
    main()
