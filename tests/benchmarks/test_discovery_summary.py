"""The arithmetic of the blind benchmark's summary, on rows made by hand."""

import json
import math

import numpy as np
import pytest
from discovery_figures import (
    Bin,
    calibration_error,
    calibration_error_by_chance,
    confusion,
    reliability,
)
from discovery_report import print_summary
from discovery_summary import expected_error, gap_closed, summary_lines
from discovery_table import Line, Rate
from scipy.stats import binom


def finding(name, probability=0.99, estimate=1.0, half=0.1, equivalent=()):
    port, effect = name.rsplit(".", 1)
    interval = [estimate - half, estimate + half]
    return {
        "effect": effect,
        "port": port,
        "probability": probability,
        "alternatives": {name: probability},
        "equivalent_to": list(equivalent),
        "parameters": {"size": {"mean": estimate, "sd": half / 1.881, "hdi_94": interval}},
    }


def row(condition="one", truth=("hinge.bias",), found=(), verdict="none", d=10.0, **others):
    rmse = {"before": 3.0, "after": 1.2, "noise_floor": 1.0, "closed": 0.9}
    result = {
        "rig": "pendulum",
        "condition": condition,
        "truth": list(truth),
        "alternatives": [],
        "true_parameters": {f"{name}.size": 1.0 for name in truth},
        "verdict": verdict,
        "problems": [],
        "p_value": 0.5,
        "effects": list(found),
        "bic": None,
        "sparse": {"first": None, "terms": {}, "left_out": ""},
        "gap": {"rmse": rmse},
        "true_model": {"rmse": 1.0},
        "d": d,
        "cpu": 10.0,
        "seconds": {"fit": 1.0, "check data": 2.0, "screen": 3.0, "search": 4.0},
    }
    return result | others


def sparse(name, left_out=""):
    return {"first": name, "terms": {}, "left_out": left_out}


def lines(rows):
    return {line.condition: line for line in summary_lines(rows)}


@pytest.mark.parametrize(("k", "n"), [(0, 8), (3, 10), (10, 10)])
def test_the_interval_is_clopper_and_pearsons(k, n):
    low, high = Rate(k, n).interval
    # At either end of the interval, as many hits or more, or fewer, have a chance of 2.5 %.
    assert low == 0.0 if k == 0 else binom.sf(k - 1, n, low) == pytest.approx(0.025)
    assert high == 1.0 if k == n else binom.cdf(k, n, high) == pytest.approx(0.025)


def test_a_target_is_met_missed_or_open():
    assert Line("x", 100, 0.99, (0.985, 1.0), lower=0.98).verdict == "yes"
    assert Line("x", 10, 0.99, (0.9, 1.0), lower=0.98).verdict == "yes, open"
    assert Line("x", 10, 0.9, (0.7, 1.0), lower=0.98).verdict == "no, open"
    assert Line("x", 100, 0.9, (0.8, 0.95), lower=0.98).verdict == "no"
    assert Line("x", 8, 0.0, (0.0, 0.37), upper=0.05, greatest_end=0.08).verdict == "no, open"
    assert Line("x", 90, 0.0, (0.0, 0.04), upper=0.05, greatest_end=0.08).verdict == "yes"
    assert Line("x", 9, 0.7, None, lower=0.85, upper=0.95).target == "85 % to 95 %"
    assert Line("x", 0, math.nan, lower=0.9).verdict == Line("x", 3, 0.5).verdict == "–"


def test_false_alarms_count_for_everyone():
    rows = [row("null", (), d=math.nan, p_value=p) for p in (0.5, 0.01, 0.2)]
    rows += [row("null_coloured", (), d=math.nan, bic="hinge.bias", sparse=sparse("hinge: v³"))]
    rows[0]["gap"]["rmse"]["after"] = 3.06
    table = lines(rows)
    alarms = table["nothing missing: false alarms"]
    assert (alarms.total, alarms.value) == (4, 0.25)
    assert (alarms.baselines.bic, alarms.baselines.sparse) == ("25 % of 4", "25 % of 4")
    assert table["… coloured noise: false alarms"].value == 0.0
    growth = table["nothing missing: greatest growth of the held-out error"]
    assert growth.value == pytest.approx(0.02)
    assert growth.verdict == "no"


def test_names_and_classes_of_one_effect():
    right = row(found=[finding("hinge.bias")], verdict="named", bic="hinge.bias")
    in_class = row(found=[finding("hinge.wind", equivalent=["bias"])], verdict="ambiguous")
    wrong = row(found=[finding("hinge.wind")], verdict="named", sparse=sparse("hinge.bias"))
    weak = row(d=5.0)
    table = lines([right, in_class, wrong, weak])
    line = table["one effect, d ≥ 10: name or class first"]
    assert (line.total, line.value) == (3, pytest.approx(2 / 3))
    assert line.baselines.refit == "0 %"
    assert line.baselines.bic == line.baselines.sparse == "33.3 % of 3"
    assert table["one effect, d = 5: name or class first"].total == 1
    assert table["one effect: confident wrong name"].value == 0.25


def test_the_worst_effect_is_named():
    rows = [row(found=[finding("hinge.bias")], verdict="named") for _ in range(3)]
    rows += [
        row(truth=("hinge.spring",), found=found) for found in ([finding("hinge.spring")], ())
    ]
    assert lines(rows)["… worst effect (spring)"].value == 0.5


def test_alternatives_stand_for_the_truth_in_pairs():
    pair = ("hinge.bias", "torque.input_delay")
    other = [["hinge.wind", "torque.input_delay"]]
    both = row("two", pair, [finding(n) for n in other[0]], "named", alternatives=other)
    one = row("two", pair, [finding("hinge.bias"), finding("hinge.spring")], "named")
    three = row("two", pair, [finding(n) for n in (*pair, "hinge.spring")], "named")
    table = lines([both, one, three])
    assert table["two effects: both"].value == pytest.approx(2 / 3)
    assert table["two effects: at least one"].value == 1.0
    assert table["two effects: spurious third"].value == pytest.approx(1 / 3)


def test_each_of_a_pair_needs_a_finding_in_whose_place_it_could_stand():
    pair = ("hinge.bias", "torque.input_delay")
    bias = finding("hinge.bias", equivalent=["input_delay"])
    late = finding("angle.sensor_delay", equivalent=["input_delay"])
    table = lines([row("two", pair, [bias, late]), row("two", pair, [bias])])
    assert table["two effects: both"].value == 0.0
    assert table["two effects: both, or in their classes"].value == 0.5


def test_what_has_no_name_is_unknown_or_has_an_impostor():
    rows = [
        row("outside", ("hinge.cubic_damping",), (), "unknown", sparse=sparse("hinge: v³")),
        row("without", found=[finding("hinge.wind")], verdict="named", bic="hinge.wind"),
        row("without", found=[finding("hinge.wind", 0.5)], verdict="named"),
    ]
    table = lines(rows)
    unknown = table["not in the catalogue: “unknown”"]
    assert unknown.value == pytest.approx(1 / 3)
    assert unknown.baselines.sparse == "33.3 % of 3"
    impostor = table["not in the catalogue: confident impostor"]
    assert impostor.value == pytest.approx(1 / 3)
    assert (impostor.baselines.bic, impostor.baselines.sparse) == ("33.3 % of 3", "0 % of 3")


def test_gaps_within_the_noise_and_weak_effects_do_not_count():
    def gap(after, before=3.0):
        # What a model without error would have counts for nothing: the true model's has been seen.
        return {"rmse": {"before": before, "after": after, "noise_floor": 0.5, "closed": 0.5}}

    rows = [row(gap=gap(3.0 - k / 5)) for k in range(11)]
    rows += [
        row(gap=gap(9.0, before=1.04)),
        row(gap=gap(9.0), d=5.0),
        row(gap=gap(9.0), true_model=None),
        row("null", (), d=math.nan),
    ]
    assert gap_closed(rows) == pytest.approx([k / 10 for k in range(11)])
    table = lines(rows)
    assert table["held-out gap closed, d ≥ 10: median"].value == pytest.approx(0.5)
    assert table["held-out gap closed, d ≥ 10: 10th percentile"].value == pytest.approx(0.1)
    error = table["held-out error in that of the true model, median"]
    assert (error.value, error.baselines.refit) == (pytest.approx(2.0), "3")


def test_parameters_are_judged_by_90_percent_intervals():
    # 0.09 is inside the 94 % interval of half width 0.1, not inside that of 90 %.
    found = [finding("hinge.bias", estimate=e) for e in (1.0, 1.08, 1.09, 0.7)]
    table = lines([row(found=[f], verdict="named") for f in found])
    assert table["parameters, d ≥ 10: 90 % intervals cover"].value == 0.5
    error = table["parameters, d ≥ 10: median relative error"]
    assert error.value == pytest.approx(0.085)


def test_the_calibration_error_weighs_bins_by_their_cases():
    sure = [row(found=[finding("hinge.bias", 1.0)]) for _ in range(3)]
    unsure = [row(found=[finding(name, 0.52)]) for name in ("hinge.bias", "hinge.wind")]
    bins = reliability([*sure, *unsure, row()])
    assert [(part.right.hits, part.right.total) for part in bins] == [(1, 2), (3, 3)]
    assert calibration_error(bins) == pytest.approx(2 / 5 * 0.02)


def test_what_cannot_be_told_apart_has_its_probability_together():
    found = finding("angle.encoder_bias", 0.7)
    found["alternatives"] |= {"gravity.tilt": 0.2, "hinge.bias": 0.1}
    hidden = row(truth=("gravity.tilt",), found=[found]) | {
        "alternatives": [["angle.encoder_bias"], ["hinge.unbalance"]]
    }
    (part,) = reliability([hidden])
    assert part.mean == pytest.approx(0.9)  # of a pendulum's offset, whichever it is
    assert part.right.hits == 1


def test_perfect_probabilities_err_by_chance():
    few, many = ([Bin(0.8, 0.9, 0.85, Rate(round(0.85 * n), n))] for n in (20, 2000))
    normal = 1.96 * (0.85 * 0.15 / 2000) ** 0.5
    assert calibration_error_by_chance(many) == pytest.approx(normal, rel=0.1)
    assert 8.0 < calibration_error_by_chance(few) / calibration_error_by_chance(many) < 12.0


def test_confusion_tells_places_and_verdicts_apart():
    table = confusion(
        [
            row(found=[finding("hinge.bias")], verdict="named"),
            row(found=[finding("rail.bias")], verdict="named"),
            row(found=[finding("hinge.wind")], verdict="unknown"),
            row("null", ()),
            row("without", found=[finding("hinge.wind")], verdict="named"),
        ]
    )
    assert table["bias"] == {"bias": 1, "bias elsewhere": 1, "unknown": 1}
    assert table["nothing"] == {"none": 1}
    assert table["bias (removed)"] == {"wind": 1}


def test_baselines_that_were_not_run_are_not_counted():
    missing = row(sparse=sparse(None, "not installed"))
    old = {k: v for k, v in row().items() if k not in ("sparse", "seconds")}
    table = lines([missing, old])
    line = table["one effect, d ≥ 10: name or class first"]
    assert line.baselines.sparse == "not installed"
    assert table["greatest time of screening, on the clock"].value == 6.0
    assert lines([old])[line.condition].baselines.sparse == "–"


def test_everything_is_printed_and_drawn(tmp_path, capsys):
    path = tmp_path / "rows.jsonl"
    rows = [
        row(found=[finding("hinge.bias")], verdict="named"),
        row("null", (), d=math.nan),
        {"rig": "emps", "condition": "one", "error": "DataError: too large", "cpu": 1.0},
    ]
    path.write_text("".join(json.dumps(r) + "\n" for r in rows))
    print_summary(path, figures=True)
    printed = capsys.readouterr().out
    assert "2 cases, 1 failed" in printed
    table = [line for line in printed.splitlines() if line.startswith("| one effect, d ≥ 10")]
    assert table == [
        "| one effect, d ≥ 10: name or class first | 1 | 100 % | 2.5 % to 100 % | ≥ 98 % | "
        "yes, open | 0 % | 0 % of 1 | 0 % of 1 |"
    ]
    for name in ("confusion.svg", "reliability.svg"):
        assert "<svg" in (tmp_path / "rows_figures" / name).read_text()


def test_no_rows_make_a_table_without_figures():
    assert all(line.verdict == "–" for line in summary_lines([]))


def test_an_error_that_posteriors_expect_is_that_of_their_own_draws():
    generator = np.random.default_rng(0)
    deviations = [0.02, 0.1, 0.5, math.nan]
    errors = np.abs(generator.standard_normal((100_000, 3)) * deviations[:3])
    # The standard error of a median of 3e5 values is far below the tolerance.
    assert expected_error(deviations) == pytest.approx(float(np.median(errors)), rel=0.02)


def test_errors_of_several_rigs_have_a_line_each():
    rows = [
        row(found=[finding("hinge.bias", estimate=1.0)]),
        row(found=[finding("hinge.bias", estimate=1.5, half=0.1)], rig="furuta"),
    ]
    found = lines(rows)
    assert found["… pendulum: median relative error"].value == pytest.approx(0.0)
    assert found["… furuta: median relative error"].value == pytest.approx(0.5)
    assert found["… furuta: 90 % intervals cover"].value == 0.0
