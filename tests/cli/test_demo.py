"""`npdr demo`, small: what it prints and writes, and the report on it."""

import functools
import json

import pytest

from npdr_ppl.display.reports import read_run, write_report
from npdr_ppl.reproduction import demo
from tests.helpers.command_line import run_for_module
from tests.helpers.small_demo import FILTER, LOOP, NUM_STEPS, OPTIONS

SMALL = functools.partial(demo.run_demo, options=OPTIONS, loop=LOOP, num_steps=NUM_STEPS)


def run(*words):
    """Runs `npdr demo`, small; returns exit code, output and error text."""
    with pytest.MonkeyPatch.context() as context:
        context.setattr(demo, "run_demo", SMALL)
        return run_for_module("demo", *words)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The folder of a story told once for all tests, and what was printed."""
    out = tmp_path_factory.mktemp("demo") / "out"
    code, text, err = run("--out", out)
    assert code == 0, err
    return out, text


@pytest.mark.slow
def test_the_story_is_printed_and_written(told):
    out, text = told
    for words in ("policy from the prior earns", "revise the model", "sensor_low_pass at"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 100
    for name in ("demo.json", "train.json", "report.html", "learning_curve.png", "rollouts.png"):
        assert (out / name).stat().st_size > 500


@pytest.mark.slow
def test_the_filter_of_the_rates_is_found_on_the_rig(told):
    out, _ = told
    result = json.loads((out / "demo.json").read_text())
    (effect,) = result["effects"]
    assert (effect["port"], effect["effect"]) == (FILTER.port, "sensor_low_pass")
    # A difference over a step of 2 ms lags by half of it more.
    expected = demo.RIG.velocity_time_constant + 0.001
    assert effect["parameters"]["time_constant"]["mean"] == pytest.approx(expected, rel=0.1)
    assert "revise the model" in [d["decision"] for d in result["decisions"]]
    assert set(result["returns"]) == {"policy from the prior", "policy from the revised model"}


@pytest.mark.slow
def test_told_again_it_is_the_same_story(told):
    out, _ = told
    first = json.loads((out / "demo.json").read_text())
    trained = json.loads((out / "train.json").read_text())
    # The same command again runs nothing again.
    code, text, _ = run("--out", out, "--json", "--quiet")
    assert code == 0
    assert json.loads(text)["returns"] == first["returns"]
    again = SMALL(out, progress=False)
    assert json.loads(json.dumps(again.result)) | {"cpu_seconds": first["cpu_seconds"]} == first
    assert json.loads(json.dumps(again.training.to_dict())) == trained


@pytest.mark.slow
def test_the_report_tells_it(told):
    out, _ = told
    titles = [section.title for section in read_run(out).sections]
    assert titles[0] == "Returns on the rig"
    assert {"Effects", "Revised model", "The rig in truth", "Decisions"} <= set(titles)
    text = write_report(out).read_text()
    returns = json.loads((out / "demo.json").read_text())["returns"]
    assert f"{returns['policy from the prior']:.0f}" in text
    assert "sensor_low_pass" in text


def test_the_story_begins_with_the_prior_and_has_room_for_another_rollout():
    assert demo.DEMO_OPTIONS.starts_from_prior and demo.DEMO_OPTIONS.extra_rollouts == 1
    assert demo.DEMO_OPTIONS.discovers == "after diagnosis"
