"""The report on a run of the NPDR loop."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.display.reports.charts import ChartPart, drawn_points, lines_chart
from npdr_ppl.display.reports.content import (
    Explained,
    FindingsPart,
    Headline,
    KeyFigure,
    Part,
    Report,
    Section,
    TablePart,
    TextPart,
    Tone,
)
from npdr_ppl.display.reports.fit_report import parameters_table
from npdr_ppl.display.reports.meanings import findings
from npdr_ppl.display.reports.provenance import provenance_section, run_description, source_section
from npdr_ppl.drawing.effect_names import in_words
from npdr_ppl.drawing.numbers import number
from npdr_ppl.loop.policy_check import NextStep
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import TrainingRecord

__all__ = ["training_report"]

Records = Sequence[Mapping[str, Any]]

MAX_POLICY_PARAMETERS = 50
"""Maximum number of policy parameters that are listed; those of a network are not."""


def training_report(folder: Path) -> Report:
    """Reads the results of ``npdr train``.

    Args:
        folder: Folder with ``train.json``.
    """
    result = read_json(folder / "train.json", TrainingRecord)
    description = run_description(folder)
    records = result["iterations"]
    last = records[-1] if records else {}
    diagnosis = _last_diagnosis(last)
    sections = [
        Section("Returns", _returns(records)),
        Section("Decisions", [FindingsPart(_decisions(records))]),
        Section("Parameters", _parameters(last, diagnosis)),
        Section("Policy", _policy(result)),
        *_rollout(folder),
        *source_section(description),
        provenance_section(description, folder),
    ]
    if diagnosis:
        sections.insert(3, Section("Last diagnosis", [FindingsPart(findings(diagnosis))]))
    title = f"Training of a policy, {len(records)} iterations"
    return Report("train", title, _verdict(result, records), _key_figures(records), sections)


def _verdict(result: Mapping[str, Any], records: Records) -> Headline:
    if not records:
        return Headline("nothing yet", "No iteration is finished.", "warn")
    deployed = result.get("deployed")
    first, best = records[0].get("real_return"), max(_real(records), default=float("nan"))
    gain = (
        f"On the target, the first return was {number(first, '.4g')} and the best was "
        f"{number(best, '.4g')}."
    )
    if deployed is None:
        word = "last policy"
        sentence = f"{gain} The result is the last policy, which has not run on the target."
        return Headline(word, sentence, "warn")
    measured = records[deployed].get("real_return") if deployed < len(records) else None
    word = f"policy of iteration {deployed + 1}"
    return Headline(
        word, f"{gain} The resulting policy was measured: {number(measured, '.4g')}.", "good"
    )


def _real(records: Records) -> list[float]:
    return [float(r["real_return"]) for r in records if r.get("real_return") is not None]


def _key_figures(records: Records) -> list[KeyFigure]:
    last = records[-1] if records else {}
    real = _real(records)
    effects = ", ".join(str(name) for name in last.get("effects") or [])
    added = [KeyFigure("Effects of the model", effects)] if effects else []
    count = sum(len(record.get("real_returns") or []) for record in records)
    return [
        KeyFigure("Best return on the target", number(max(real, default=None), ".4g")),
        KeyFigure("First return on the target", number(real[0] if real else None, ".4g")),
        KeyFigure(
            "Last return in simulation", number(last.get("sim_return"), ".4g"), "over domains"
        ),
        KeyFigure(
            "Last success in simulation",
            number(last.get("simulated_success"), ".0%"),
            "of episodes in the posterior's draws",
        ),
        KeyFigure("Real rollouts", str(last.get("num_rollouts", count))),
        *added,
        KeyFigure("Last decision", str(last.get("decision", "–"))),
    ]


def _returns(records: Records) -> list[Part]:
    numbers = [float(n) for n in range(1, len(records) + 1)]
    lines = {
        "on the target": (numbers, [record.get("real_return") for record in records]),
        # The policy that an iteration trains runs in the next iteration.
        "in simulation": ([n + 1 for n in numbers], [r.get("sim_return") for r in records]),
    }
    caption = "Return of the policy that ran in each iteration; in simulation, mean over domains."
    return [lines_chart("returns", lines, titles=("iteration", "return"), caption=caption)]


def _decisions(records: Records) -> list[Explained]:
    result = []
    for index, record in enumerate(records, start=1):
        for decision in record.get("decisions") or [record]:
            word = str(decision.get("decision", "–"))
            tone: Tone = "good" if word == "accept" else "warn"
            did = decision.get("action")
            excitation = decision.get("excitation")
            if did and excitation:
                did = f"{did}, with {excitation['name'].replace('_', ' ')}"
            meaning = (
                f"{decision.get('reason', '')} The loop {did}."
                if did
                else str(decision.get("reason", ""))
            )
            meaning = in_words(meaning).replace("`", "")
            result.append(Explained(f"Iteration {index}", word, tone, meaning))
        for check in record.get("checks") or []:
            word = str(check["decision"])
            passed: Tone = "good" if word == NextStep.DEPLOY else "warn"
            name = f"Iteration {index}, the new policy"
            result.append(Explained(name, word, passed, str(check["reason"])))
    return result


def _last_diagnosis(record: Mapping[str, Any]) -> Mapping[str, Any]:
    decisions = record.get("decisions") or []
    return (decisions[-1].get("diagnosis") or {}) if decisions else {}


def _parameters(record: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[Part]:
    parameters = record.get("parameters") or {}
    if not parameters:
        return [TextPart("The last iteration has no posterior.")]
    contraction = diagnosis.get("contraction") or {}
    model = record.get("internal_model") or {}
    return [
        parameters_table(parameters, units={}, most_likely=model, contraction=contraction),
    ]


def _policy(result: Mapping[str, Any]) -> list[Part]:
    policy = result.get("policy") or {}
    if not policy or len(policy) > MAX_POLICY_PARAMETERS:
        return [TextPart(f"The policy has {len(policy)} parameters; train.json lists them.")]
    rows = [[name, number(value, ".4g")] for name, value in policy.items()]
    return [TablePart(("parameter", "value"), rows, "The resulting policy.")]


def _rollout(folder: Path) -> list[Section]:
    """Draws the last real rollout."""
    files = sorted((folder / "rollouts").glob("*.nc"))
    if not files:
        return []
    rollouts = Rollouts.from_netcdf(files[-1])
    readings = np.asarray(rollouts.series()[0], dtype=float)
    time = np.asarray(rollouts.time[0], dtype=float)[: len(readings)]
    kept = drawn_points(len(time))
    charts: list[ChartPart] = [
        lines_chart(
            f"rollout-{index}",
            {name: (time[kept].tolist(), readings[kept, index].tolist())},
            titles=("time [s]", f"{name} [{unit}]" if unit else name),
            caption=f"{name} in the last real rollout.",
        )
        for index, (name, unit) in enumerate(
            zip(rollouts.channel_names, rollouts.channel_units, strict=False)
        )
    ]
    return [Section("Last real rollout", charts)]
