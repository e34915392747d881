"""Runs side by side: whether they agree, judged by an independent route."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from npdr_ppl.display.reports import write_runs_report
from npdr_ppl.display.reports.run_summary import Estimate
from npdr_ppl.display.reports.runs_report import LEVEL, disagreement, runs_report
from npdr_ppl.errors import DataError


def search(folder, *, mass=1.0, sd=0.01, effects=(("coulomb_friction", "hinge"),), data="a"):
    """Writes a search with one parameter."""
    folder.mkdir()
    low, high = mass - 1.9 * sd, mass + 1.9 * sd
    found = {
        "verdict": "named",
        "parameters": {"mass": {"mean": mass, "sd": sd, "hdi_94": [low, high], "unit": "kg"}},
        "effects": [{"effect": e, "port": p, "probability": 0.97} for e, p in effects],
        "gap": {"rmse": {"before": 0.2, "after": 0.05, "noise_floor": 0.05, "closed": 1.0}},
    }
    (folder / "discovery.json").write_text(json.dumps(found))
    run = {"model": {"name": "pendulum"}, "seed": 0, "recordings": [data]}
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def findings(report):
    return {f.name: f.value for f in report.sections[0].parts[0].findings}


def estimates(means, sds):
    return [Estimate(m, s, m - s, m + s, "") for m, s in zip(means, sds, strict=True)]


def test_runs_of_equal_results_agree(tmp_path):
    runs = [search(tmp_path / "a"), search(tmp_path / "b", mass=1.01, data="b")]
    report = runs_report(runs)
    assert report.verdict.word == "The runs agree"
    assert findings(report) == {"Parameters": "1 of 1 agree", "Effects": "the same"}


def test_a_difference_of_many_standard_deviations_is_reported(tmp_path):
    report = runs_report([search(tmp_path / "a"), search(tmp_path / "b", mass=1.1)])
    assert report.verdict.word == "The runs disagree"
    assert "1 of 1 shared parameter differs by more than chance: mass" in report.verdict.sentence


def test_an_effect_of_one_run_only_is_reported(tmp_path):
    more = (("coulomb_friction", "hinge"), ("input_delay", "torque"))
    report = runs_report([search(tmp_path / "a"), search(tmp_path / "b", effects=more)])
    assert report.verdict.sentence == "Not every search found torque delay."


def test_laws_of_other_formulas_are_other_effects(tmp_path):
    runs = [search(tmp_path / name, effects=(), data=name) for name in "ab"]
    for run, formula in zip(runs, ("c₁ v³", "c₁ v|v|"), strict=True):
        content = json.loads((run / "discovery.json").read_text())
        law = {"port": "hinge", "effect": "learned_hinge", "formula": formula, "unit": "N m"}
        law["with_numbers"] = formula.replace("c₁", "0.1")
        content["learned"] = {"offered": True, "laws": [law]}
        row = content["parameters"]["mass"]
        content["parameters"]["hinge.learned_hinge.c1"] = row
        (run / "discovery.json").write_text(json.dumps(content))
    report = runs_report(runs)
    assert report.verdict.sentence == (
        "Not every search found learned law c₁ v³ at hinge, learned law c₁ v|v| at hinge."
    )
    assert findings(report)["Parameters"] == "1 of 1 agree"


def test_agreement_on_the_same_recording_comes_with_a_warning(tmp_path):
    report = runs_report([search(tmp_path / "a"), search(tmp_path / "b")])
    assert findings(report)["Recordings"] == "the same"


def test_the_p_value_is_that_of_scipy():
    means, sds = [1.0, 1.3, 0.9], [0.1, 0.2, 0.15]
    weights = np.array(sds) ** -2.0
    q = (weights * (means - np.average(means, weights=weights)) ** 2).sum()
    assert disagreement(estimates(means, sds)) == pytest.approx(chi2.sf(q, 2))


def test_right_posteriors_disagree_as_rarely_as_stated():
    rng, sds = np.random.default_rng(0), np.array([0.1, 0.02, 0.3])
    draws = rng.standard_normal((4000, 3)) * sds
    share = np.mean([disagreement(estimates(row, sds)) < LEVEL for row in draws])
    # Four standard errors of a share of 4000.
    assert abs(share - LEVEL) < 4 * (LEVEL / 4000) ** 0.5


def test_a_fit_and_a_search_are_compared(runs, tmp_path):
    found = search(tmp_path / "search", mass=0.9)
    page = write_runs_report([runs["fit"], found], tmp_path / "runs.html").read_text()
    assert "2 runs side by side" in page and "mass [kg]" in page


def test_runs_that_cannot_be_compared_are_refused_with_a_sentence(runs, tmp_path):
    one = search(tmp_path / "a")
    with pytest.raises(DataError, match="given twice"):
        runs_report([one, one])
    with pytest.raises(DataError, match="give runs of npdr fit"):
        runs_report([one, runs["compare"]])
    other = tmp_path / "other"
    other.mkdir()
    content = {"backend": "nuts", "parameters": {}}
    (other / "fit.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="no parameter in common"):
        runs_report([one, other])
