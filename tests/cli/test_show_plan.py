"""What `npdr plan` says after its table."""

import pytest

from npdr_ppl.cli.show_plan import show_plan

OUTLOOK = {
    "chance_of_the_right_name": 0.62,
    "chance_of_a_wrong_name": 0.01,
    "random_chance_of_the_right_name": 0.4,
    "wanted_chance": 0.9,
    "needed_rollouts": 14,
    "most_needed_rollouts": 60,
    "with_twice_the": {},
}


def told(capsys, tmp_path, starts=({"angle": 0.0},), **outlook):
    pair = {"one": "a", "other": "b", "before": 1.0, "after": 3.0, "random": 2.0}
    found = {
        "separations": [pair],
        "outlook": OUTLOOK | outlook,
        "rollouts": len(starts),
        "duration": 5.0,
        "starts": list(starts),
        "has_stopped": False,
    }
    show_plan(found, tmp_path / "next.csv")
    return " ".join(capsys.readouterr().out.split())


def test_a_plan_that_suffices_says_how_probably(capsys, tmp_path):
    text = told(capsys, tmp_path, chance_of_the_right_name=0.97)
    assert "name the right cause in 97% of such cases, and a wrong one in 1%" in text
    assert "with random commands the right one in 40%" in text
    assert "are needed" not in text and "do not suffice" not in text
    assert "Hold it at rest at angle 0 first." in text and "for 5 s are in" in text


@pytest.mark.parametrize(
    ("outlook", "sentence"),
    [
        ({}, "For 90%, about 14 rollouts are needed: --rollouts 14."),
        ({"needed_rollouts": None}, "even 60 rollouts do not suffice for 90%."),
        (
            {"with_twice_the": {"channels": 0.9, "bandwidth": 0.8, "commands": 0.63}},
            "With up to twice the positions and speeds: 90%, with up to twice the bandwidth: 80%.",
        ),
        (
            {"with_twice_the": {"channels": 0.64}},
            "A short search within limits up to twice as wide found nothing better.",
        ),
    ],
)
def test_a_plan_that_does_not_suffice_says_what_would(outlook, sentence, capsys, tmp_path):
    assert sentence in told(capsys, tmp_path, **outlook)


def test_each_start_is_told_once(capsys, tmp_path):
    text = told(capsys, tmp_path, starts=({"angle": 0.0}, {"angle": 1.5}, {"angle": 0.0}))
    assert "Hold it at rest at angle 0 before rollouts 0, 2." in text
    assert "Hold it at rest at angle 1.5 before rollout 1." in text
    assert "for 3 rollouts of 5 s are in" in text
