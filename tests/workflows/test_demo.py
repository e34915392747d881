"""The demonstration, small: what it writes, and the report on it."""

import json

import pytest

from npdr_ppl.reports import read_run, write_report
from npdr_ppl.workflows.demo import DEMO_OPTIONS, RIG, run_demo
from tests.workflows.small_demo import FILTER, NUM_STEPS, OPTIONS


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    return out, run_demo(out, options=OPTIONS, num_steps=NUM_STEPS, progress=False)


def test_the_filter_of_the_rates_is_found_on_the_rig(told):
    out, story = told
    result = json.loads((out / "demo.json").read_text())
    assert result == json.loads(json.dumps(story.result))
    (effect,) = result["effects"]
    assert (effect["port"], effect["effect"]) == (FILTER.port, "sensor_low_pass")
    # A difference over a step of 2 ms lags by half of it more.
    expected = RIG.velocity_time_constant + 0.001
    assert effect["parameters"]["time_constant"]["mean"] == pytest.approx(expected, rel=0.1)
    assert "revise the model" in [d["decision"] for d in result["decisions"]]
    assert set(result["returns"]) == {"policy from the prior", "policy from the revised model"}


def test_told_again_it_is_the_same_story(told):
    out, story = told
    again = run_demo(out, options=OPTIONS, num_steps=NUM_STEPS, progress=False)
    assert again.result["returns"] == story.result["returns"]
    assert again.training.to_dict() == story.training.to_dict()


def test_the_report_tells_it(told):
    out, story = told
    titles = [section.title for section in read_run(out).sections]
    assert titles[0] == "Returns on the rig"
    assert {"Effects", "Revised model", "The rig in truth", "Decisions"} <= set(titles)
    text = write_report(out).read_text()
    assert f"{story.result['returns']['policy from the prior']:.0f}" in text
    assert "sensor_low_pass" in text


def test_the_story_begins_with_the_prior_and_has_room_for_another_rollout():
    assert DEMO_OPTIONS.starts_from_prior and DEMO_OPTIONS.extra_rollouts == 1
    assert DEMO_OPTIONS.discovers == "after diagnosis"
