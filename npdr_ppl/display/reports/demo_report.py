"""The report on the demonstration: returns before and after, and the result of discovery."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.charts import bars_chart
from npdr_ppl.display.reports.content import (
    Headline,
    KeyFigure,
    Part,
    Report,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.display.reports.discovery_report import discovery_report
from npdr_ppl.display.reports.training_report import training_report
from npdr_ppl.drawing.effect_names import effect_label
from npdr_ppl.drawing.numbers import number
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DemoRecord

__all__ = ["demo_report"]

SHARED = ("Effects", "Measured and simulated", "Where", "Revised model")
"""Sections that are taken from the report on the discovery."""


def demo_report(folder: Path) -> Report:
    """Reads the results of ``npdr demo``.

    Args:
        folder: Folder with ``demo.json`` and the run of the loop.
    """
    result = read_json(folder / "demo.json", DemoRecord)
    returns = result["returns"]
    revision = folder / "revision_0"
    found: list[Section] = []
    if (revision / "discovery.json").exists():
        sections = discovery_report(revision).sections
        found = [section for section in sections if section.title in SHARED]
    rest = [s for s in training_report(folder).sections if s.title != "Returns"]
    sections = [
        Section("Returns on the rig", _returns(returns)),
        *found,
        Section("The rig in truth", _truth(result["truth"])),
        *rest,
    ]
    figures = [KeyFigure(name, number(value, ".0f")) for name, value in returns.items()]
    figures.append(KeyFigure("Effects added", str(len(result["effects"]))))
    return Report("demo", "The story of a rig", _verdict(result), figures, sections)


def _verdict(result: Mapping[str, Any]) -> Headline:
    before, after = result["returns"].values()
    gain = f"The return on the rig changed from {before:.0f} to {after:.0f}."
    names = ", ".join(map(effect_label, result["effects"]))
    if not names:
        return Headline("nothing was found", f"Discovery named no missing effect. {gain}", "warn")
    succeeds = after >= result["success"]
    meaning = f"Added: {names}. {gain} Above {result['success']:.0f} the pole balances upright."
    word = "the revised model's policy works" if succeeds else "the policy still fails"
    return Headline(word, meaning, "good" if succeeds else "warn")


def _returns(returns: Mapping[str, float]) -> list[Part]:
    caption = "Return of one episode on the rig, simulated by MuJoCo; the maximum is 2500."
    return [bars_chart("returns", {"return": dict(returns)}, title="return", caption=caption)]


def _truth(truth: Mapping[str, Any]) -> list[Part]:
    rows = [[name, number(value, ".4g")] for name, value in truth.items() if name != "parameters"]
    rows += [[name, number(value, ".4g")] for name, value in truth["parameters"].items()]
    text = (
        "The loop never used these values. Friction is MuJoCo's own, which yields slightly before "
        "it slips, and velocities are filtered differences of encoder steps. Both are similar to "
        "the catalogue's effects, but not the same formulas."
    )
    return [TextPart(text), TablePart(("quantity", "value in SI units"), rows)]
