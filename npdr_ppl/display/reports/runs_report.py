"""Several runs side by side: do they agree?"""

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.content import (
    DrawingPart,
    Explained,
    FindingsPart,
    FoldedPart,
    Headline,
    Part,
    Report,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.display.reports.run_summary import Estimate, RunSummary, summaries
from npdr_ppl.drawing.bars_html import METRICS, interval_bars
from npdr_ppl.drawing.effect_names import effect_label, effect_title, why_unnamed
from npdr_ppl.drawing.numbers import number
from npdr_ppl.errors import DataError

__all__ = ["disagreement", "runs_report"]

LEVEL = 0.01
"""Probability that runs whose posteriors are right are said to disagree, over all parameters
together; the same as the false-alarm rate of a search."""

MOST_LEADING = 3
"""Maximum number of parameters on the first screen; those that disagree most come first."""

MOST_UNFOLDED = 12
"""Maximum number of parameters that are shown without a click."""

Runs = Sequence[RunSummary]


def runs_report(folders: Sequence[Path]) -> Report:
    """Compares runs: parameters with intervals, effects and gaps.

    Args:
        folders: Folders of ``npdr fit``, ``discover`` or ``train``; two or more.

    Raises:
        DataError: The runs have nothing in common, or a folder is not that of a run.
    """
    runs = summaries(folders)
    shared = _shared(runs)
    searched = [run for run in runs if run.effects is not None]
    if not shared and len(searched) < 2:
        raise DataError(
            "The runs have no parameter in common; give runs of the same model, or searches."
        )
    p_values = {name: disagreement(list(rows.values())) for name, rows in shared.items()}
    apart = [name for name, p in p_values.items() if p < LEVEL / len(p_values)]
    order = sorted(shared, key=lambda name: p_values[name])
    drawings = {name: _drawn(name, shared[name], name in apart) for name in order}
    lead = [DrawingPart("".join(drawings[n] for n in order[:MOST_LEADING]), _caption(order))]
    sections = [
        Section("Do the runs agree?", [FindingsPart(_findings(runs, shared, apart))]),
        Section("Effects", _effects(searched)),
        *_parameters(drawings),
        *_gaps(runs),
        Section("Runs", [_table(runs)]),
    ]
    title = f"{len(runs)} runs side by side"
    verdict = _verdict(runs, shared, [name for name in order if name in apart])
    return Report("report", title, verdict, [], sections, lead if shared else [])


def disagreement(estimates: Sequence[Estimate]) -> float:
    """Returns the p-value of the hypothesis that all runs estimate the same value.

    Cochran's Q: the squared distances from the mean, in standard deviations, are χ²-distributed
    with one degree of freedom less than there are runs (Cochran 1954, Biometrics 10, 101–129).

    Args:
        estimates: The parameter in each run.
    """
    import torch

    known = [e for e in estimates if e.sd > 0.0]
    if len(known) < 2:
        return 1.0
    weights = [e.sd**-2 for e in known]
    mean = sum(w * e.mean for w, e in zip(weights, known, strict=True)) / sum(weights)
    q = sum(w * (e.mean - mean) ** 2 for w, e in zip(weights, known, strict=True))
    half = torch.tensor([0.5 * (len(known) - 1), 0.5 * q], dtype=torch.float64)
    return float(torch.special.gammaincc(half[0], half[1]))


def _shared(runs: Runs) -> dict[str, dict[str, Estimate]]:
    """Returns the parameters that at least two runs estimate, by name and run.

    Those of a learned law are not shared with a law of another formula at the same port.
    """
    formulas: dict[str, set[str]] = {}
    for run in runs:
        for effect, formula in run.laws.items():
            formulas.setdefault(effect, set()).add(formula)
    names = dict.fromkeys(name for run in runs for name in run.parameters)
    rows = {
        name: {run.label: run.parameters[name] for run in runs if name in run.parameters}
        for name in names
    }
    return {
        name: found
        for name, found in rows.items()
        if len(found) > 1 and len(formulas.get(name.rpartition(".")[0], ())) < 2
    }


def _verdict(runs: Runs, shared: Mapping[str, Any], apart: Sequence[str]) -> Headline:
    differing = _differing_effects(runs)
    count = f"{len(shared)} shared {'parameter' if len(shared) == 1 else 'parameters'}"
    if not apart and not differing:
        sentences = []
        if shared:
            sentences.append(f"Chance explains the differences of all {count}.")
        if _are_searched(runs):
            sentences.append("The searches found the same effects.")
        return Headline("The runs agree", " ".join(sentences), "good")
    reasons = []
    if apart:
        names = ", ".join(map(_parameter_words, apart[:MOST_LEADING]))
        more = f" and {len(apart) - MOST_LEADING} more" if len(apart) > MOST_LEADING else ""
        verb = "differs" if len(apart) == 1 else "differ"
        reasons.append(f"{len(apart)} of {count} {verb} by more than chance: {names}{more}")
    if differing:
        reasons.append(f"Not every search found {', '.join(differing[:MOST_LEADING])}")
    return Headline("The runs disagree", f"{'. '.join(reasons)}.", "bad")


def _parameter_words(name: str) -> str:
    """Returns a parameter's name in words; that of an effect's has the effect's title."""
    port_effect, _, parameter = name.rpartition(".")
    port, _, effect = port_effect.rpartition(".")
    if not effect:
        return name.replace("_", " ")
    return f"{effect_title(effect, port)}: {parameter.replace('_', ' ')}"


def _are_searched(runs: Runs) -> bool:
    return sum(run.effects is not None for run in runs) > 1


def _differing_effects(runs: Runs) -> list[str]:
    """Returns the large effects that some of the searches did not find."""
    found = [_large(run) for run in runs if run.effects is not None]
    if len(found) < 2:
        return []
    every = dict.fromkeys(name for names in found for name in names)
    # A search may have kept an effect that another one found as a small one.
    any_size = [{_title(e) for e in run.effects} for run in runs if run.effects is not None]
    return [name for name in every if not all(name in names for names in any_size)]


def _large(run: RunSummary) -> list[str]:
    return [_title(effect) for effect in run.effects or () if not why_unnamed(effect)]


def _title(effect: Mapping[str, Any]) -> str:
    return effect_title(str(effect.get("effect")), str(effect.get("port") or ""))


def _findings(runs: Runs, shared: Mapping[str, Any], apart: Sequence[str]) -> list[Explained]:
    result = []
    if shared:
        result.append(
            Explained(
                "Parameters",
                f"{len(shared) - len(apart)} of {len(shared)} agree",
                "bad" if apart else "good",
                "Differences are compared with the standard deviations of the posteriors "
                "(Cochran's Q). If all posteriors are right, a difference is reported with a "
                f"probability of {LEVEL:.0%}.",
            )
        )
    if _are_searched(runs):
        differing = _differing_effects(runs)
        result.append(
            Explained(
                "Effects",
                "differ" if differing else "the same",
                "bad" if differing else "good",
                f"Not found by every search: {', '.join(differing)}."
                if differing
                else "Every search found the same large effects.",
            )
        )
    if len(runs) > 1 and all(run.data and run.data == runs[0].data for run in runs):
        result.append(
            Explained(
                "Recordings",
                "the same",
                "warn",
                "All runs used the same recordings, so that only seeds and settings are compared. "
                "Whether another recording gives the same result is not known.",
            )
        )
    models = {run.model for run in runs if run.model}
    if len(models) > 1:
        names = ", ".join(sorted(models))
        meaning = f"Parameters of the same name may have another meaning in {names}."
        result.append(Explained("Models", "different", "warn", meaning))
    return result


def _caption(order: Sequence[str]) -> str:
    shown = f"The {MOST_LEADING} parameters that differ most, of {len(order)}"
    head = "All shared parameters" if len(order) <= MOST_LEADING else shown
    return f"{head}: mean and 94 % interval of each run."


def _drawn(name: str, rows: Mapping[str, Estimate], is_apart: bool) -> str:
    """Returns one parameter's intervals with a heading."""
    unit = next((e.unit for e in rows.values() if e.unit not in ("", "1")), "")
    words = {
        label: f"{number(e.mean, '.4g')} ± {number(e.sd, '.2g')}" for label, e in rows.items()
    }
    spans = {label: (e.low, e.mean, e.high) for label, e in rows.items()}
    title = f"{_parameter_words(name)} [{unit}]" if unit else _parameter_words(name)
    word = "differs" if is_apart else "agrees"
    head = f"<div><b>{escape(title)}</b> <small>{word}</small></div>"
    return head + interval_bars(spans, words)


def _parameters(drawings: Mapping[str, str]) -> list[Section]:
    if len(drawings) <= MOST_LEADING:  # The first screen shows them.
        return []
    every = list(drawings.values())
    caption = "Mean and 94 % interval of each run; those that differ most come first."
    parts: list[Part] = [DrawingPart("".join(every[:MOST_UNFOLDED]), caption)]
    if rest := every[MOST_UNFOLDED:]:
        parts.append(FoldedPart(f"{len(rest)} more parameters", [DrawingPart("".join(rest))]))
    return [Section("Parameters", parts)]


def _effects(searched: Runs) -> list[Part]:
    if not searched:
        return [TextPart("None of the runs searched for effects.")]
    titles = dict.fromkeys(_title(effect) for run in searched for effect in run.effects or ())
    if not titles:
        return [TextPart("No search found an effect.")]
    rows = [[title, *(_found(run, title) for run in searched)] for title in titles]
    columns = ("effect", *(run.label for run in searched))
    caption = "Size and probability of each effect in each run; a dash if it was not found."
    return [TablePart(columns, rows, caption)]


def _found(run: RunSummary, title: str) -> str:
    for effect in run.effects or ():
        if _title(effect) == title:
            size = effect_label(effect).removeprefix(title).removeprefix(", ")
            parts = [size, number(effect.get("probability"), ".0%")]
            why = why_unnamed(effect)
            return ", ".join(part for part in parts if part) + (f" ({why})" if why else "")
    return "–"


def _gaps(runs: Runs) -> list[Section]:
    metrics = dict.fromkeys(metric for run in runs for metric in run.gap)
    if not metrics:
        return []
    rows = [
        [METRICS.get(metric, metric), *(_gap_words(run.gap.get(metric)) for run in runs)]
        for metric in metrics
    ]
    caption = (
        "Errors on the held-out rollouts of each run, before → after, and the share of the gap "
        "that was closed. They can be compared only if the held-out rollouts are the same."
    )
    columns = ("metric", *(run.label for run in runs))
    return [Section("Gaps", [TablePart(columns, rows, caption)])]


def _gap_words(values: Mapping[str, Any] | None) -> str:
    if not values:
        return "–"
    after = number(values.get("after"))
    if values.get("before") is None:
        return after
    words = f"{number(values['before'])} → {after}"
    closed = values.get("closed")
    if closed is None or not math.isfinite(closed):
        return words
    return f"{words} ({min(closed, 1.0):.0%})"


def _table(runs: Runs) -> TablePart:
    rows = [[run.label, run.kind, run.model or "–", run.verdict, run.seed] for run in runs]
    return TablePart(("run", "command", "model", "result", "seed"), rows, layout="prose")
