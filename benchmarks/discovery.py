"""The blind benchmark of discovery: hidden effects, verdicts, and how often they are right.

    python benchmarks/discovery.py --part tune --out tune.jsonl   # thresholds were set here
    python benchmarks/discovery.py --part test --out test.jsonl --workers 2
    python benchmarks/discovery.py --summary test.jsonl --figures

The truths are made by :mod:`hidden_rigs`: equations, integrators and laws of their own. An
effect's strength is set by its separation d: the distance, in standard deviations of the
readings, between the recordings with and without it once all nominal parameters are refitted.
Of two effects at one place, it is the smaller distance to a model with only one of them.
Rows are written as they come, and a run given again continues. Tuning and reporting use other
seeds, hence other parameters, excitations and noise.
"""

import argparse
import functools
import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from discovery_report import print_summary
from discovery_rows import REMOVED, SEVERAL
from hidden_rigs import RIGS, Case, Place, make_case, places
from hidden_rigs.under_test import as_hidden
from sparse_regression import sparse_choice

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import Hypothesis, fit_hypothesis
from npdr_ppl.discovery.proof.held_out_gap import prove
from npdr_ppl.discovery.proof.parameter_intervals import posterior_draws
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.segment_options import segment_options, short_segments
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import candidate_effects
from npdr_ppl.preparation.data_options import DataOptions

SEEDS = {"tune": range(100), "test": range(1000, 1400)}
"""Seeds of both parts."""

SEPARATIONS = (5.0, 10.0, 30.0)
CHECKABLE, MEASURABLE = 30.0, 40.0
"""From which separation on it stands out of the noise, and one that is measured well. Two
recordings of a Furuta pendulum already differ by up to 10 if they only have noise, because fitted
initial states absorb other parts of it. So smaller separations are scaled down from
``MEASURABLE``."""

NEARLY, TRIES = 1.5, 12
"""How many times the wanted separation is not too much, and how many strengths are tried."""

STRONGEST = 30.0
"""Multiple of a typical size beyond which no rig of this kind is, of what others leave."""


@dataclass(frozen=True)
class Task:
    """One case to be judged.

    Attributes:
        rig: Name of the rig.
        condition: What is hidden, or ``"without"``: one effect, its entry taken from the
            catalogue; or ``"beyond"``: the same, and so strong that all other entries together
            leave the separation.
        place: Index of what is hidden among the rig's places.
        separation: Separation to set the strength by; 0 for the rig's typical size.
        seed: The case's seed.
    """

    rig: str
    condition: str
    place: int
    separation: float
    seed: int


def tasks(
    conditions: list[str], rigs: list[str], seeds: list[int], separations: list[float]
) -> Iterator[Task]:
    """Returns all cases, seed by seed so that a run stopped early is balanced."""
    for number, seed in enumerate(seeds):
        for condition in conditions:
            for rig in rigs:
                hidden = "one" if condition in REMOVED else condition
                count = len(places(rig, hidden, seed))  # pyright: ignore[reportArgumentType]
                for place in range(count):
                    if condition in ("one", *REMOVED):
                        # One separation per place and seed, in turn.
                        wanted = separations[(place + number) % len(separations)]
                    else:
                        wanted = separations[-1] if condition in (*SEVERAL, "outside") else 0.0
                    yield Task(rig, condition, place, wanted, seed)


def judge(task: Task) -> dict[str, Any]:
    """Makes a case, discovers, and returns the row."""
    torch.set_num_threads(1)
    row: dict[str, Any] = asdict(task)
    start = time.process_time()
    try:
        case, strength, separation = _case(task)
        row |= {
            "strength": strength,
            "d": separation,
            "truth": list(case.names),
            "alternatives": [list(a) for a in case.alternatives],
            "true_parameters": {
                f"{h.name}.{n}": float(v) for h in case.truth for n, v in h.parameters.items()
            },
        }
        search = npdr.DiscoveryOptions(effects=_catalogue(task, case))
        found = npdr.discover(
            case.model, case.fit, holdout=case.holdout, search=search, seed=task.seed
        )
        row |= {
            "verdict": found.verdict,
            "reason": found.reason,
            "problems": list(found.problems),
            "p_value": found.alarm.p_value,
            "left_p_value": found.remainder.p_value,
            "unexplained": found.unexplained,
            "effects": [finding.to_dict() for finding in found.effects],
            "ranking": [candidate.name for candidate in found.ranking[:5]],
            "bic": bic_choice(found),
            "sparse": sparse_choice(found.search.rounds[0].hypothesis, case.fit).to_dict(),
            "gap": {name: gap.to_dict() for name, gap in found.gap.items()},
            "true_model": true_model_errors(case, found),
            "seconds": found.seconds,
        }
    except Exception as error:  # a failure is a row with its message
        row["error"] = f"{type(error).__name__}: {error}"[:300]
    return row | {"cpu": time.process_time() - start}


def _case(task: Task) -> tuple[Case, float | tuple[float, ...], float]:
    """Returns a case, its strength and its separation; of two effects each one's strength."""
    condition: Any = "one" if task.condition in REMOVED else task.condition
    chosen = places(task.rig, condition, task.seed)[task.place]

    def at(strength: float | tuple[float, ...]) -> Case:
        return make_case(task.rig, condition, chosen, strength=strength, seed=task.seed)

    if not task.separation:
        return at(1.0), 1.0, float("nan")
    if task.condition == "beyond":
        return _beyond(task, at)
    if task.condition in SEVERAL:
        # At the same multiple of their typical sizes, perhaps only one of them is detectable.
        alone = replace(task, condition="one")
        each, found = zip(*(_strength(alone, (place,)) for place in chosen), strict=True)
        if task.condition == "two_at_one_place":
            # One of them alone could explain both.
            factor, least = meet_separation(
                lambda factor: _separation_of_each(at(tuple(factor * own for own in each))),
                task.separation,
                strongest=STRONGEST,
            )
            each, found = tuple(factor * own for own in each), (least,)
        return at(each), each, min(found)
    strength, found = _strength(task, chosen)
    return at(strength), strength, found


def _strength(task: Task, hidden: Sequence[Place]) -> tuple[float, float]:
    """Returns the multiple of its typical size that has the separation, and what it has.

    Raises:
        ValueError: There is none.
    """
    condition: Any = "one" if task.condition in REMOVED else task.condition

    def separated(strength: float) -> float:
        case = make_case(task.rig, condition, hidden, strength=strength, seed=task.seed)
        return separation(case)

    if task.separation >= CHECKABLE:
        return meet_separation(separated, task.separation)
    strength, found = meet_separation(separated, MEASURABLE)
    # Elasticity and play grow faster than their strength.
    power = math.log2(found / max(separated(0.5 * strength), 1e-9))
    less = (task.separation / found) ** (1.0 / min(3.0, max(1.0, power)))
    return less * strength, task.separation


def _beyond(task: Task, at: Callable[[float], Case]) -> tuple[Case, float, float]:
    """Returns a case of which all entries but the true one leave the wanted separation.

    Raises:
        ValueError: They leave less even of a strength that no rig of this kind has.
    """

    def left(strength: float) -> float:
        case = at(strength)
        return separation(case, _catalogue(task, case))

    strength, found = meet_separation(left, task.separation, strongest=STRONGEST)
    return at(strength), strength, found


def meet_separation(
    measure: Callable[[float], float], wanted: float, *, strongest: float = math.inf
) -> tuple[float, float]:
    """Returns a strength that has the wanted separation or little more, and what it has.

    Args:
        measure: Returns the separation of a multiple of the typical size.
        wanted: The least separation.
        strongest: Strength beyond which none is tried.

    Raises:
        ValueError: There is none.
    """
    weak, strong, strength, most = 0.0, math.inf, 1.0, 0.0
    for _ in range(TRIES):
        try:
            found = measure(strength)
        except DataError:  # the truth is unstable
            found = math.inf
        most = max(most, found)
        if wanted <= found < wanted * NEARLY:
            return strength, found
        # It need not grow steadily, and a stop is hit or not: once bracketed, halve the bracket.
        if found < wanted:
            weak = strength
        else:
            strong = strength
        if 0.0 < weak < strong < math.inf:
            strength = math.sqrt(weak * strong)
        else:
            strength *= min(10.0, max(0.1, wanted * math.sqrt(NEARLY) / max(found, 1e-9)))
        if strength > strongest:
            break
    raise ValueError(f"no strength separates by {wanted:g}, the most was {most:.1f}")


def separation(case: Case, catalogue: tuple[npdr.Effect, ...] = ()) -> float:
    """Returns how far the recording is from what the refitted model explains.

    The square root of the misfit that goes beyond what the noise alone leaves, which the same
    case without anything hidden shows; it needs no law of the catalogue.

    Args:
        case: The case.
        catalogue: Effects that a search may add to the model before it is judged.
    """
    options = npdr.DiscoveryOptions(effects=catalogue)
    searcher = Searcher(case.model, case.fit, options, data_options=_segments(case))
    hidden, null = searcher.fit_base(), _quiet(case.rig, case.seed)
    if catalogue:
        hidden = searcher.run(searcher.look(hidden), max_effects=options.max_effects).final
    scale = null.fit.scale
    excess = 2.0 * float((hidden.losses(scale) - null.losses(scale)).sum())
    return max(excess, 0.0) ** 0.5


def _separation_of_each(case: Case) -> float:
    """Returns the smaller distance from the model with both effects to one without one of them.

    All are fitted to one recording, so that different noise does not count as separation. The
    distance is infinite if the model cannot be simulated without either of them.

    Raises:
        DataError: The model with both effects cannot be simulated.
    """
    searcher = Searcher(
        case.model, case.fit, npdr.DiscoveryOptions(), data_options=_segments(case)
    )
    base = searcher.fit_base()
    known = {effect.name: effect for effect in candidate_effects(base.simulator)}
    start = {name: torch.tensor(v).double() for h in case.truth for name, v in h.sites.items()}
    effects = tuple(as_hidden(known[hidden.name], hidden) for hidden in case.truth)
    both = searcher.trials.refitted(base, effects, start=start)
    if both is None:
        raise DataError("The model with both effects cannot be simulated.")
    scale, least = both.fit.scale, math.inf
    for effect in both.effects:
        alone = searcher.trials.without(both, effect)
        if alone is not None:
            left = 2.0 * float((alone.losses(scale) - both.losses(scale)).sum())
            least = min(least, max(left, 0.0))
    return math.sqrt(least)


@functools.lru_cache(maxsize=1)
def _quiet(rig: str, seed: int) -> Hypothesis:
    """Returns the fit to a case without anything hidden; every strength is compared with it."""
    case = make_case(rig, "null", (), seed=seed)
    options = npdr.DiscoveryOptions()
    return Searcher(case.model, case.fit, options, data_options=_segments(case)).fit_base()


def _segments(case: Case) -> DataOptions:
    """Returns segments of the same length whatever is hidden, so that losses can be compared."""
    return short_segments(case.fit)


def _catalogue(task: Task, case: Case) -> tuple[npdr.Effect, ...] | None:
    """Returns the effects to search, without the true one where it is to be missing."""
    if task.condition not in REMOVED:
        return None
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions())
    every = candidates_at(searcher.fit_base(), searcher.options)
    gone = {name for names in (case.names, *case.alternatives) for name in names}
    ids = {name.rsplit(".", 1)[1] for name in case.names}
    return tuple(e for e in every if e.name not in gone and e.id not in ids)


def true_model_errors(case: Case, found: npdr.Discovery) -> dict[str, float] | None:
    """Returns the metrics of the true model on the held-out recording.

    The model under test with the true effects and parameters: what a gap can close to. ``None``
    where the catalogue has no such effect.
    """
    given = found.search.rounds[0].hypothesis
    known = {effect.name: effect for effect in candidate_effects(given.simulator)}
    if case.condition == "bad_data" or not known.keys() >= set(case.names):
        return None
    truth = {name: torch.tensor(v) for h in case.truth for name, v in h.sites.items()}
    truth |= {name: torch.tensor(value) for name, value in case.parameters.items()}
    same = DataOptions(segment_length=given.segments.inputs.num_steps)
    true = fit_hypothesis(
        given.model,
        case.fit,
        segment_options(case.fit, same),
        effects=tuple(as_hidden(known[hidden.name], hidden) for hidden in case.truth),
        start={name: value.double() for name, value in truth.items()},
        max_steps=0,
    )
    gap = prove(
        given,
        true,
        case.holdout,
        segment_options(case.holdout, same),
        draws_before=posterior_draws(given, seed=0),
        draws_after=posterior_draws(true, seed=0),
        seed=0,
    )
    return {name: part.after for name, part in gap.items()}


def bic_choice(found: npdr.Discovery) -> str | None:
    """Returns what forward selection by BIC would add first, every reading counted; a baseline."""
    first = found.search.rounds[0].hypothesis
    misfit = Projection(first).misfit
    num = first.linearisation.residual.numel()
    best, name = 0.0, None
    for candidate in found.ranking:
        left = max(misfit - candidate.gain, 1e-12 * misfit)
        gain = num * math.log(misfit / left) - len(candidate.sizes) * math.log(num)
        if gain > best:
            best, name = gain, candidate.name
    return name


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("rig", "condition", "place", "separation", "seed"))


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="The blind benchmark of discovery.")
    parser.add_argument("--part", choices=sorted(SEEDS), default="tune")
    parser.add_argument("--conditions", default="null,null_noise3,null_coloured,null_outliers,one")
    parser.add_argument("--rigs", default=",".join(RIGS))
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--separations", default=",".join(map(str, SEPARATIONS)))
    parser.add_argument("--every", type=int, default=1, help="judge only every n-th case")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("discovery.jsonl"))
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    parser.add_argument("--figures", action="store_true", help="draw them beside the rows")
    arguments = parser.parse_args()
    if arguments.summary:
        print_summary(arguments.summary, figures=arguments.figures)
        return
    done = set()
    if arguments.out.exists():
        done = {_key(json.loads(line)) for line in arguments.out.read_text().splitlines()}
    first = arguments.first_seed
    seeds = list(SEEDS[arguments.part])[first : first + arguments.num_seeds]
    all_tasks = tasks(
        arguments.conditions.split(","),
        arguments.rigs.split(","),
        seeds,
        [float(d) for d in arguments.separations.split(",")],
    )
    chosen = itertools.islice(all_tasks, 0, None, arguments.every)
    wanted = [task for task in chosen if _key(asdict(task)) not in done]
    print(f"{len(wanted)} cases to judge, {len(done)} done", flush=True)
    with (
        arguments.out.open("a") as file,
        ProcessPoolExecutor(arguments.workers) as pool,
    ):
        for future in as_completed(pool.submit(judge, task) for task in wanted):
            row = future.result()
            file.write(json.dumps(row) + "\n")
            file.flush()
            found = [f"{e['port']}.{e['effect']}" for e in row.get("effects", [])]
            print(
                f"{row['rig']} {row['condition']} d {row.get('d', 0.0):.1f} {row.get('truth')} → "
                f"{row.get('verdict', row.get('error'))} {found} {row['cpu']:.0f} s",
                flush=True,
            )
    print_summary(arguments.out, figures=arguments.figures)


if __name__ == "__main__":
    main()
