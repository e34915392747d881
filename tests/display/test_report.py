"""Reports: what they say, that they stand alone, and that nothing in a run becomes markup."""

import json
import re
import shutil
from html.parser import HTMLParser

import plotly.graph_objects as go
import pytest

from npdr_ppl.display.reports import read_run, write_report
from npdr_ppl.display.reports.content import DiffPart, FindingsPart, unfolded
from npdr_ppl.display.reports.meanings import findings
from npdr_ppl.display.reports.next_steps import next_section
from npdr_ppl.display.reports.run_report import MAX_BYTES
from npdr_ppl.errors import DataError
from tests.helpers.arm_discovery import write_arm_discovery

KINDS = ("fit", "compare", "train", "discover")


class Elements(HTMLParser):
    """Collects elements and what they refer to."""

    def __init__(self):
        super().__init__()
        self.tags, self.links = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset")]


@pytest.fixture(scope="session")
def pages(runs, tmp_path_factory):
    """The written files by kind."""
    folder = tmp_path_factory.mktemp("pages")
    return {kind: write_report(runs[kind], folder / f"{kind}.html") for kind in KINDS}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_page_stands_alone(pages, kind):
    text = pages[kind].read_text()
    assert len(text.encode()) < MAX_BYTES
    # A search is drawn without a script, which keeps its page small.
    assert text.count("* plotly.js v") == (kind != "discover")
    page = Elements()
    page.feed(text)
    assert all(link.startswith(("#", "data:")) for link in page.links), page.links
    assert "default-src 'none'" in text
    assert "prefers-color-scheme: dark" in text
    assert text.index('class="verdict') < text.index('class="figures') < text.index("<section")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fit", "compare", "train"])
def test_charts_are_what_plotly_understands(runs, kind):
    charts = [
        part
        for s in read_run(runs[kind]).sections
        for part in unfolded(s.parts)
        if part.kind == "chart"
    ]
    assert charts
    assert len({chart.name for chart in charts}) == len(charts)
    for chart in charts:
        go.Figure({"data": list(chart.data), "layout": dict(chart.layout)})


@pytest.mark.slow
def test_a_fit_says_what_its_json_says(runs, pages):
    result = json.loads((runs["fit"] / "fit.json").read_text())
    text = pages["fit"].read_text()
    assert f"<strong>{result['diagnosis']['decision']}</strong>" in text
    for name, row in result["parameters"].items():
        assert name in text
        assert format(row["mean"], ".4g") in text
    assert "def pendulum(inputs" in text
    assert re.search(r"<td[^>]*>[0-9a-f]{64}</td>", text)


@pytest.mark.slow
def test_labels_of_a_run_are_no_markup(pages):
    assert "<b>abc" not in pages["compare"].read_text()
    assert "&lt;b&gt;abc" in pages["compare"].read_text()
    assert "&#39;&lt;script&gt;&#39;" in pages["discover"].read_text()


@pytest.mark.slow
def test_training_shows_every_decision(runs, pages):
    iterations = json.loads((runs["train"] / "train.json").read_text())["iterations"]
    parts = [p for s in read_run(runs["train"]).sections for p in s.parts]
    decisions = next(part for part in parts if isinstance(part, FindingsPart))
    shown = sum(len(row["decisions"]) + len(row.get("checks", ())) for row in iterations)
    assert len(decisions.findings) == shown


@pytest.mark.slow
def test_discovery_shows_what_changed(runs):
    report = read_run(runs["discover"])
    assert report.verdict.word == "Missing: dry friction at hinge, 0.4 N m"
    assert "93% in RMSE" in report.verdict.sentence
    (diff,) = [part for s in report.sections for part in s.parts if isinstance(part, DiffPart)]
    assert [line for line in diff.lines if line[0] == "+"][1:] == ["+    friction = '<script>'"]


def test_small_effects_and_parts_of_the_recording_are_shown(runs, tmp_path):
    folder = shutil.copytree(runs["discover"], tmp_path / "run")
    content = json.loads((folder / "discovery.json").read_text())
    content["effects"][0] |= {
        "share": 0.04,
        "is_minor": True,
        "parts": [
            {"part": part, "strengths": {"magnitude": {"mean": mean, "sd": 0.02}}}
            for part, mean in (("the first half", 0.41), ("the second half", 0.39))
        ],
    }
    bias = {"effect": "bias", "port": "hinge", "probability": 1.0, "share": 0.9}
    content["effects"].append(bias)
    (folder / "discovery.json").write_text(json.dumps(content))
    text = write_report(folder).read_text()
    assert "4% (small)" in text and "Missing: constant force at hinge" in text
    assert "the second half" in text and "0.39 ± 0.02" in text


def test_an_effect_that_a_half_contradicts_is_no_headline(runs, tmp_path):
    folder = shutil.copytree(runs["discover"], tmp_path / "run")
    content = json.loads((folder / "discovery.json").read_text())
    content["effects"][0]["found_in"] = [
        {"part": "the first half", "is_found": True, "probability": 1.0, "instead": ""},
        {
            "part": "the second half",
            "is_found": False,
            "probability": 0.9,
            "instead": "hinge.bias",
            "contradicts": True,
        },
        {
            "part": "the recording without rollout 0",
            "is_found": False,
            "probability": 0.4,
            "instead": "",
            "contradicts": False,
        },
    ]
    content["effects"][0]["doubt"] = "is contradicted by the second half of the recording"
    bias = {"effect": "bias", "port": "hinge", "probability": 1.0, "share": 0.9}
    content["effects"].append(bias)
    (folder / "discovery.json").write_text(json.dumps(content))
    text = write_report(folder).read_text()
    assert "Missing: constant force at hinge" in text
    assert "Does a part of the recording alone show the effect?" in text
    assert "explained better by" in text and "constant force at hinge</td>" in text
    assert "no, contradicts it" in text and "no, too weak to show it" in text


def test_a_learned_law_is_the_headline_and_is_shown_where_it_was_checked(tmp_path):
    law = {
        "port": "hinge",
        "unit": "N m",
        "formula": "c₁ v³",
        "with_numbers": "− 0.02 v³",
        "constants": {"c1": {"value": -0.02, "unit": "N m/(rad/s)³"}},
        "ranges": {"v": [-3.0, 4.0]},
    }
    learned = {
        "offered": True,
        "laws": [law],
        "checks": [{"where": "the held-out rollouts", "before": 12.5, "after": 1.5}],
        "depends_on": {"hinge": {"v": 0.99, "q": 0.0}},
        "alike": {"hinge": {"effect": "hinge.quadratic_drag", "correlation": 0.93}},
    }
    content = {"verdict": "learned", "reason": "Learned.", "learned": learned}
    (tmp_path / "discovery.json").write_text(json.dumps(content))
    assert read_run(tmp_path).verdict.word == "Learned: − 0.02 v³ N m at hinge"
    text = write_report(tmp_path).read_text()
    for part in ("N m/(rad/s)³", "the held-out rollouts", "12.5", "v 99%", "correlation 0.93"):
        assert part in text
    content = {"verdict": "unknown", "learned": learned | {"offered": False}}
    (tmp_path / "discovery.json").write_text(json.dumps(content))
    assert "Learned law, not offered" in write_report(tmp_path).read_text()


@pytest.mark.parametrize("verdict", ["none", "named", "ambiguous", "unknown", "learned"])
def test_a_discovery_of_little_is_shown_too(tmp_path, verdict):
    (tmp_path / "discovery.json").write_text(json.dumps({"verdict": verdict}))
    assert verdict in write_report(tmp_path).read_text() or verdict != "unknown"


def test_where_no_excitation_helps_the_report_does_not_ask_for_another_recording():
    differing = {"gain": {"left": 1.59, "right": 1.4}}
    nothing = {"excitation": None, "separated_by": "", "separations": {}, "differing": differing}
    measure = next_section({"verdict": "ambiguous", "next_experiment": nothing})
    (found,) = measure.parts[0].findings
    assert found.value == "measure a parameter in which they differ"
    assert "npdr plan" not in found.meaning
    assert any("Measuring gain (1.59 with left" in str(part) for part in measure.parts)
    for experiment in (None, {**nothing, "excitation": "chirp", "amplitude": {}}):
        record = next_section({"verdict": "ambiguous", "next_experiment": experiment})
        assert record.parts[0].findings[0].value == "record again"


def test_changed_curves_are_refused_with_a_sentence(tmp_path):
    write_arm_discovery(tmp_path / "arm")
    file = tmp_path / "arm" / "overlays.json"
    whole = file.read_text()
    for change, sentence in (
        (lambda found: found["rollouts"][0]["time"].pop(), "differ in length"),
        (lambda found: found.pop("maps"), "missing required field"),
        (lambda found: found["maps"][0].update(before=[[1.0] * 900_000]), "too many values"),
        (lambda found: found["units"].update(joint_1=3), "Expected `?str"),
    ):
        found = json.loads(whole)
        change(found)
        file.write_text(json.dumps(found))
        with pytest.raises(DataError, match=sentence):
            write_report(tmp_path / "arm")


def test_an_arms_rows_are_short_and_name_effects_in_words(tmp_path):
    write_arm_discovery(tmp_path / "arm")
    report = read_run(tmp_path / "arm")
    effects = next(s for s in report.sections if s.title == "Effects").parts[0]
    assert effects.rows[0][0] == "motor joint 1 gain error, -5 %"
    # A row of four cells of this length has at most two lines on a page of 60 rem.
    assert max(len(cell) for row in effects.rows for cell in row) < 70
    assert len(report.verdict.word) + len(report.verdict.sentence) < 250
    page = write_report(tmp_path / "arm").read_text()
    first = page[: page.index("<section")]
    assert "actuator_gain" not in first and 'class="revised"' in first


@pytest.mark.parametrize(
    ("name", "value", "tone"),
    [
        ("r_hat", 1.01, "good"), ("r_hat", 1.5, "warn"), ("r_hat", None, "plain"),
        ("ess", 2000, "good"), ("ess", 20, "warn"),
        ("coverage_90", 0.9, "good"), ("coverage_90", 0.5, "bad"),
        ("segment_p_value", 0.4, "good"), ("segment_p_value", 0.0, "bad"),
    ],
)  # fmt: skip
def test_diagnostics_are_judged_as_diagnose_judges_them(name, value, tone):
    order = ("r_hat", "ess", "coverage_90", "segment_p_value", "pit_deviation")
    assert findings({name: value})[order.index(name)].tone == tone


def test_a_folder_that_is_no_run_is_refused_with_a_sentence(tmp_path):
    with pytest.raises(DataError, match="not a folder"):
        read_run(tmp_path / "absent")
    with pytest.raises(DataError, match="holds none of"):
        read_run(tmp_path)
    (tmp_path / "fit.json").write_text("{}")
    with pytest.raises(DataError, match="not what npdr writes"):
        read_run(tmp_path)
