"""What a reader does after a discovery: the decision, its reason, the next experiment."""

from collections.abc import Mapping
from typing import Any

from npdr_ppl.discovery.proof.settings import EXPERIMENT
from npdr_ppl.display.reports.content import (
    CodePart,
    DrawingPart,
    Explained,
    FindingsPart,
    Part,
    Section,
    TablePart,
    TextPart,
    Tone,
)
from npdr_ppl.drawing.bars_html import named_bars
from npdr_ppl.drawing.effect_names import in_words
from npdr_ppl.drawing.experiment_words import values_that_differ
from npdr_ppl.drawing.numbers import number

__all__ = ["next_section"]

STEPS: Mapping[str, tuple[str, Tone, str]] = {
    "none": (
        "use the model",
        "good",
        "Its parameters explain the recording. An effect too small to detect may be missing.",
    ),
    "named": (
        "use the revised model",
        "good",
        "revised_model.py has the effects and is a MODEL for every command; logs need the same "
        "--mapping.",
    ),
    "ambiguous": (
        "record again",
        "warn",
        "The revised model has the likeliest cause. It predicts well under a similar excitation, "
        "but possibly not under another.",
    ),
    "unknown": (
        "do not rely on the revised model",
        "bad",
        "It explains only a part, or its explanation is doubtful. Repair faults of the recording "
        "first; otherwise learn a law with --learn, or add an effect of your own.",
    ),
    "learned": (
        "read the law, and use the revised model",
        "good",
        "learned_effect.py has the formula and the range for which it was learned. It may be "
        "wrong beyond that range.",
    ),
}
"""What to do, its rating and its reason, by verdict."""

COMMANDS: Mapping[str, str] = {
    "learned": "npdr fit revised_model.py:revised_model --data RECORDING --out fit",
    "named": "npdr fit revised_model.py:revised_model --data RECORDING --out fit",
    "ambiguous": "npdr plan RUN MODEL --out next.csv\n"
    "npdr discover MODEL --data RECORDING --data NEW_RECORDING --out discovery_2",
}


def next_section(result: Mapping[str, Any], *, said: str = "") -> Section:
    """Returns the decision with its reason, and the next experiment if there is one.

    Args:
        result: Content of ``discovery.json``.
        said: What the verdict says already; such a reason is not repeated.
    """
    verdict = str(result.get("verdict", ""))
    step, tone, why = STEPS.get(verdict, ("continue the search", "plain", ""))
    if result.get("has_stopped"):
        step = "continue the search"
        why = "A time limit ended it. The same command with a longer limit continues it."
    elif verdict == "ambiguous":
        step, told = _to_tell_apart(result.get("next_experiment"))
        why = f"{why} {told}"
    findings = [Explained("Next", step, tone, why)]
    reason = in_words(str(result.get("reason") or ""))
    if reason and reason != said:
        findings.append(Explained("Reason", verdict, "plain", reason))
    parts: list[Part] = [FindingsPart(findings)]
    if verdict in COMMANDS and not result.get("has_stopped"):
        parts.append(CodePart(COMMANDS[verdict]))
    if experiment := result.get("next_experiment"):
        parts += _experiment(experiment)
    return Section("What to do next", parts)


def _to_tell_apart(experiment: Any) -> tuple[str, str]:
    """Returns what to do to tell the causes apart, in a few words and in a sentence."""
    if isinstance(experiment, Mapping) and experiment.get("excitation", "") is None:
        if values_that_differ(experiment):
            told = "No excitation that was tried tells the causes apart."
            return "measure a parameter in which they differ", told
    return "record again", "Record what npdr plan designs, and search both recordings together."


def _experiment(experiment: Any) -> list[Part]:
    if not isinstance(experiment, Mapping):
        return [TextPart(f"Next experiment: {experiment}.")]
    parts: list[Part] = []
    if "excitation" in experiment:
        name = experiment["excitation"]
        words = str(name).replace("_", " ") if name else "none of those tried distinguishes them"
        by = experiment.get("separated_by")
        hint = f" What separates them in general: {by}." if by else ""
        parts.append(TextPart(f"Next experiment, excitation: {words}.{hint}"))
    if differing := values_that_differ(experiment):
        also = " also" if experiment.get("excitation") else ""
        parts.append(TextPart(f"Measuring {differing}{also} tells the causes apart."))
    separations = experiment.get("separations")
    if isinstance(separations, Mapping):
        bars = {
            str(name).replace("_", " "): float(value)
            for name, value in separations.items()
            if value is not None
        }
        caption = (
            "Smallest distance between the causes under each excitation, in standard deviations "
            f"of the measurements; above {EXPERIMENT.useful_separation:g} the recording tells "
            "them apart."
        )
        parts.append(DrawingPart(named_bars(bars, spec=".3g"), caption))
    skipped = ("excitation", "separated_by", "separations", "amplitude", "least", "differing")
    rows = [[str(n), _words(v)] for n, v in experiment.items() if n not in skipped]
    amplitude = experiment.get("amplitude")
    if isinstance(amplitude, Mapping):
        rows += [[f"greatest {n}".replace("_", " "), number(v)] for n, v in amplitude.items()]
        least = experiment.get("least") or {}
        rows += [[f"least {n}".replace("_", " "), number(v)] for n, v in least.items()]
    elif amplitude is not None:
        rows.append(["amplitude", _words(amplitude)])
    if rows:
        parts.append(TablePart(("command", "value"), rows, "The recording to make."))
    return parts


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_words(item) for item in value)
    return number(value) if isinstance(value, float) else str(value)
