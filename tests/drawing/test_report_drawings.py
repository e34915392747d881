"""Drawings of reports: what they say of the numbers, and that texts are escaped."""

import re

import pytest

from npdr_ppl.drawing.bars_html import gap_bars, interval_bars, named_bars
from npdr_ppl.drawing.curves_html import curve
from npdr_ppl.drawing.effect_names import TITLES, effect_label, effect_title, in_words, quantity
from npdr_ppl.drawing.heat_html import FIRST, SHADES, heat_levels, heat_map
from npdr_ppl.drawing.overlay_html import rollout_words
from npdr_ppl.models.effects.registry import BUILT_IN


def row(effect, port, **parameters):
    found = {name: {"mean": mean, "unit": unit} for name, (mean, unit) in parameters.items()}
    return {"effect": effect, "port": port, "parameters": found}


def points(html, name):
    """Returns the points of a path as pairs of numbers, a list per piece."""
    path = re.search(rf'class="{name}" d="([^"]*)"', html)[1]
    pieces = [piece.split("L") for piece in path.split("M") if piece]
    return [[tuple(map(float, point.split())) for point in piece] for piece in pieces]


def test_every_effect_of_the_catalogue_has_a_title():
    assert set(TITLES) == set(BUILT_IN)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (row("sensor_low_pass", "arm_velocity,pole_velocity", time_constant=(0.019, "s")),
         "velocity low-pass, 19 ms"),
        (row("sensor_low_pass", "joint_6,joint_6_velocity", time_constant=(0.0028, "s")),
         "joint 6 low-pass, 2.8 ms"),
        (row("sensor_delay", "a,b,c", delay=(0.012, "s")), "3 channels delay, 12 ms"),
        (row("input_delay", "a,b,c", delay=(0.012, "s")), "3 commands delay, 12 ms"),
        (row("input_delay", "m1,m2,m3", delay=(0.012, "s")), "m 1 to 3 delay, 12 ms"),
        (row("input_delay", "m1,m2,m4", delay=(0.012, "s")), "3 commands delay, 12 ms"),
        (row("coulomb_friction", "joint_2_torque", magnitude=(0.35, "N m")),
         "dry friction at joint 2, 0.35 N m"),
        (row("actuator_gain", "voltage", error=(-0.35, "1")), "voltage gain error, -35 %"),
        (row("unbalance", "hinge", sine=(0.3, "N m"), cosine=(-0.4, "N m")),
         "unbalance at hinge, 0.5 N m"),
        (row("tilt", "gravity", roll=(0.0, "rad"), pitch=(0.0175, "rad")), "tilted base, 1°"),
        (row("own_effect", "hinge"), "own effect at hinge"),
        ({"effect": "bias", "port": "hinge", "parameters": None}, "constant force at hinge"),
    ],
)  # fmt: skip
def test_an_effect_is_named_with_its_size(found, words):
    assert effect_label(found) == words


def test_names_inside_a_sentence_become_words():
    text = "Missing: hinge.coulomb_friction and voltage.input_delay. The model lacks 0.5."
    words = "Missing: dry friction at hinge and voltage delay. The model lacks 0.5."
    assert in_words(text) == words
    assert in_words("The strongest sign is arm_2: arm_2_velocity.") == (
        "The strongest sign is arm 2: arm 2 velocity."
    )
    assert in_words("Use revised_model.py or rollouts/x_1.nc.") == (
        "Use revised_model.py or rollouts/x_1.nc."
    )
    assert effect_title("payload", "") == "additional payload"
    assert quantity(2.5, "s") == "2.5 s"


def test_a_curve_lies_where_its_values_are():
    series = {"measured": [0.0, 1.0, 0.0], "fitted": [0.0, None, 0.5]}
    html = curve([0.0, 1.0, 2.0], series, title="angle [rad]")
    (measured,) = points(html, "measured")
    assert [x for x, _ in measured] == [0.0, 500.0, 1000.0]
    assert measured[0][1] == measured[2][1] > measured[1][1], "larger values are higher up"
    assert [len(piece) for piece in points(html, "fitted")] == [1, 1], "a gap interrupts the line"


def test_errors_are_drawn_below_the_curves():
    series = {"measured": [0.0, 1.0], "fitted": [0.5, 0.5]}
    html = curve([0.0, 1.0], series, title="angle", errors={"fitted": [0.5, -0.5]})
    upper, lower = html.split('<svg class="error"')
    assert 'class="measured"' in upper and 'class="measured"' not in lower
    ((first, last),) = points(lower, "fitted")
    assert first[1] < last[1], "positive errors are higher up"
    assert 'class="error"' not in curve([0.0, 1.0], series, title="angle")


def test_a_simulation_that_runs_away_leaves_the_measurement_visible():
    series = {"measured": [0.0, 1.0, 0.0], "nominal": [0.0, 1e6, -1e6]}
    (measured,) = points(curve([0.0, 1.0, 2.0], series, title="angle"), "measured")
    assert measured[0][1] - measured[1][1] > 140 / 4


def test_a_constant_or_absent_channel_is_drawn_without_an_error():
    assert "measured" in curve([0.0, 1.0], {"measured": [2.0, 2.0]}, title="angle")
    assert curve([0.0, 1.0], {"measured": [None, None]}, title="angle") == ""
    assert curve([], {"measured": []}, title="angle") == ""


def test_a_simulation_that_leaves_a_constant_measurement_is_visible():
    series = {"measured": [2.0, 2.0], "fitted": [2.0, 2.5]}
    ((first, last),) = points(curve([0.0, 1.0], series, title="angle"), "fitted")
    assert 0.0 < last[1] < first[1] < 140.0


def test_the_mark_of_the_coverage_is_its_target():
    coverage = {"coverage": {"before": 0.5, "after": 0.88, "noise_floor": None}}
    assert "of the coverage: 90%" in gap_bars(coverage)
    assert "coverage" not in gap_bars({"rmse": {"before": 0.2, "after": 0.1}})


def test_the_gap_says_what_was_closed():
    gap = {"rmse": {"before": 0.2, "after": 0.06, "noise_floor": 0.05, "closed": 0.93}}
    html = gap_bars(gap)
    assert "RMSE: 93% of the gap closed" in html
    assert html.index("0.2<") < html.index("0.06<")
    assert "grown" in gap_bars({"rmse": gap["rmse"] | {"after": 0.3, "closed": -0.6}})
    above = gap_bars({"rmse": gap["rmse"] | {"after": 0.04, "closed": 1.07}})
    assert "100% of the gap" in above, "a model below the floor is not better than the true one"
    assert gap_bars({"rmse": {"before": None, "after": float("nan")}}) == ""


def test_equal_intervals_without_a_width_are_drawn():
    html = interval_bars(dict.fromkeys("ab", (1e6, 1e6, 1e6)), {"a": "x", "b": "y"})
    assert html.count('class="dot" style="left:50.0%"') == 2


def test_a_held_out_rollout_is_not_taken_for_one_of_the_whole_recording():
    assert rollout_words({"rollout": 0}, {"is_held_out": True}) == "rollout 0 of those held out"
    assert rollout_words({"rollout": 2}, {"is_held_out": False}) == "rollout 2"


def test_cells_of_a_map_have_the_shade_of_their_residual():
    rows = [[1.0, 100.0, 100.0], [None, 1.0, 1.0]]
    levels = heat_levels([rows])
    assert levels[0] == FIRST and len(levels) == len(SHADES) and levels == sorted(levels)
    html = heat_map(rows, ["angle", "velocity"], levels, title="rollout 0", seconds=3.0)
    drawn = re.findall(r'fill-opacity="([^"]*)" d="([^"]+)"', html)
    assert drawn == [("1.0", "M1 0h2v1h-2z")]


def test_texts_are_escaped():
    name = "<script>alert(1)</script>"
    assert "<script>" not in named_bars({name: 1.0})
    assert "<script>" not in interval_bars({name: (0.0, 1.0, 2.0)}, {name: name})
    assert "<script>" not in curve([0.0, 1.0], {"measured": [0.0, 1.0]}, title=name, note=name)
    assert "<script>" not in heat_map([[1.0]], [name], [1.5], title=name, seconds=1.0)
    assert "<script>" not in gap_bars({name: {"before": 1.0, "after": 0.5}})
