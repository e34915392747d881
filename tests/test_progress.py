"""Progress: the estimate of the time left, the line that shows it, and lines in a log."""

import io
import itertools
import sys
import time

import pyro
import pyro.distributions as dist
import pytest
import torch
from rich.console import Console

import npdr_ppl as npdr
from npdr_ppl.discovery.search_progress import SearchProgress
from npdr_ppl.posterior.infer import infer
from npdr_ppl.progress import (
    Reporter,
    TimeLeft,
    _LineReporter,
    _LogReporter,
    reporter,
    words_for,
)


class Clock:
    """A clock that is set by hand, in s."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Line:
    """A line on a terminal of 100 characters, with a clock that is set by hand."""

    def __init__(self):
        self.clock, self.file = Clock(), io.StringIO()
        console = Console(file=self.file, force_terminal=True, width=100, color_system=None)
        self.reporter = _LineReporter(console, self.clock)

    def __str__(self):
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(self.reporter.bars.get_renderable())
        return console.file.getvalue().rstrip("\n")


def test_the_time_left_is_the_rest_at_the_mean_speed():
    clock = Clock()
    left = TimeLeft(clock)
    assert left.seconds is None
    left.report(0.0)
    assert left.seconds is None  # nothing has been done since the first report
    clock.now += 30.0
    assert left.seconds is None
    left.report(0.25)
    assert left.seconds == pytest.approx(90.0)
    clock.now += 10.0
    left.report(0.5)  # faster: half of it took 40 s
    assert left.seconds == pytest.approx(40.0)


def test_work_that_was_done_before_the_first_report_is_not_taken_as_quick():
    clock = Clock()
    left = TimeLeft(clock)
    left.report(0.8)  # read from an earlier run
    clock.now += 10.0
    left.report(0.9)
    assert left.seconds == pytest.approx(10.0)


def test_the_estimate_counts_down_until_the_next_report_is_overdue():
    clock = Clock()
    left = TimeLeft(clock)
    left.report(0.0)
    for fraction in (0.1, 0.2):
        clock.now += 10.0
        left.report(fraction)
    assert left.seconds == pytest.approx(80.0)
    clock.now += 6.0
    assert left.seconds == pytest.approx(74.0)
    clock.now += 600.0
    assert left.seconds == pytest.approx(70.0)
    left.report(0.2)  # a report without news changes nothing
    assert left.seconds == pytest.approx(70.0)


def test_no_time_is_given_for_overdue_finished_restarted_or_unknown_work():
    clock = Clock()
    left = TimeLeft(clock)
    left.report(0.0)
    clock.now += 10.0
    left.report(0.5)
    clock.now += 11.0
    assert left.seconds is None  # it should have been done
    left.report(1.0)
    assert left.seconds is None
    left.report(0.25)  # begun anew
    assert left.seconds is None
    clock.now += 5.0
    left.report(0.5)
    assert left.seconds == pytest.approx(10.0)
    left.report(None)
    assert left.seconds is None


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.4, "1 s"),
        (99.4, "99 s"),
        (150.0, "2.5 min"),
        (5900.0, "98 min"),
        (9000.0, "2.5 h"),
        (1e6, "278 h"),
    ],  # fmt: skip
)
def test_durations_have_two_digits(seconds, words):
    assert words_for(seconds) == words


def test_one_line_shows_stage_status_and_time_left():
    line = Line()
    step = line.reporter.stage("round 1/1: simulate")
    assert str(line) == ""  # a stage may have nothing to do
    step(0.0, "0 of 1000 simulations")
    line.clock.now += 60.0
    assert "0 of 1000 simulations" in str(line) and "60 s so far" in str(line)
    step(0.25, "250 of 1000 simulations")
    shown = str(line)
    assert shown.startswith("round 1/1: simulate") and shown.count("\n") == 0
    assert "250 of 1000 simulations" in shown and "about 3.0 min left in this step" in shown
    train = line.reporter.stage("train", may_end_early=True)
    train(0.0, "epoch 0")
    line.clock.now += 10.0
    train(0.5, "epoch [5]")  # no markup
    shown = str(line)
    assert shown.startswith("train") and shown.count("\n") == 0 and "simulate" not in shown
    assert "epoch [5]" in shown and "at most 10 s left in this step" in shown


def test_a_long_status_is_cut_and_the_time_is_not():
    line = Line()
    step = line.reporter.stage("discover")
    step(None, "adding " + "a law with a long name, " * 10)
    line.clock.now += 150.0
    assert str(line).count("\n") == 0 and str(line).endswith("2.5 min so far")
    assert "adding a law" in str(line)


def test_the_rounds_together_have_a_time_left_once_one_is_done():
    line = Line()
    with line.reporter.under("iteration 2").overall("all rounds") as done:
        for index in range(3):
            done(index / 3, "")
            with line.reporter.overall("parts of a round") as part:  # inside other equal parts
                part(0.0, "")
                step = line.reporter.stage("simulate")
                step(0.0, "")
                line.clock.now += 50.0
                step(0.5, "")
                if index == 0:
                    assert "about 50 s left in this step" in str(line)
                else:
                    left = 250 - 100 * index
                    words = words_for(left)
                    assert f"about {words} left for all rounds of iteration 2" in str(line)
                line.clock.now += 50.0
                part(0.5, "")
    assert "rounds" not in str(line)


def test_a_terminal_gets_one_line_that_is_removed_at_the_end():
    line = Line()
    with line.reporter.bars:
        for label in ("first", "second"):
            step = line.reporter.stage(label)
            step(0.0, "")
            line.reporter.bars.refresh()
            step(1.0, "")
    written = line.file.getvalue()
    frames = written.split("\r\x1b[2K")  # every frame overwrites the last one
    assert any("first" in frame for frame in frames)
    assert any("second" in frame for frame in frames)
    assert not any("first" in frame and "second" in frame for frame in frames)
    assert written.count("\n") == 1  # at the end, before the line is removed
    assert written.endswith("\x1b[1A\x1b[2K")


def test_short_work_without_a_terminal_shows_nothing(capfd, monkeypatch):
    for show, is_terminal in ((None, False), (False, True)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda found=is_terminal: found)
        with reporter(show) as report:
            assert type(report) is (Reporter if show is False else _LogReporter)
            step = report.stage("simulate", may_end_early=True)
            with report.under("iteration 1").overall("all rounds") as done:
                for fraction in (0.0, 0.5, None, 1.0):
                    step(fraction, "status")
                    done(fraction, "")
    assert capfd.readouterr() == ("", "")


def test_a_log_gets_a_line_per_minute():
    clock, file = Clock(), io.StringIO()
    report = _LogReporter(file, clock)
    step = report.stage("effect 1")
    for number in range(13):
        step(number / 12, f"{number} of 12 candidates fitted")
        clock.now += 20.0
    lines = file.getvalue().splitlines()
    assert [line.split()[3] for line in lines] == ["1:"] * 4
    assert "effect 1: 3 of 12 candidates fitted, about 3.0 min left in this step" in lines[0]
    assert "12 of 12 candidates fitted, 4.0 min so far" in lines[-1]


def test_a_log_gets_lines_while_a_step_is_long(monkeypatch):
    monkeypatch.setattr("npdr_ppl.progress.LOG_INTERVAL", 0.02)
    file = io.StringIO()
    report = _LogReporter(file)
    with report.watched():
        report.stage("fit")(0.0, "searching")
        for _ in range(500):
            time.sleep(0.01)
            if file.getvalue().count("fit: searching, ") >= 2:
                break
    written = file.getvalue()
    assert written.count("fit: searching, ") >= 2
    time.sleep(0.05)
    assert file.getvalue() == written


def test_a_search_uses_the_line_of_a_larger_workflow_and_else_one_of_its_own():
    line = Line()
    search = SearchProgress(line.reporter)
    with search.shown():
        search.say("fitting the original model")
        assert str(line).startswith("discover") and "fitting the original" in str(line)
        search.stage("fit candidates")(0.5, "1 of 2 candidates fitted")
    assert str(line).startswith("fit candidates")
    search.finish()
    assert "done" in str(line)
    own = SearchProgress(False)
    own.say("before any block")
    with own.shown():
        own.stage("fit candidates")(0.5, "")


class Noting(Reporter):
    """Keeps what it is told, by stage."""

    def __init__(self):
        self.told = {}

    def stage(self, label, *, may_end_early=False):
        return lambda *report: self.told.setdefault(label, []).append(report)


def blurred_mean():
    mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
    npdr.simulate("x", lambda mean: mean + torch.randn_like(mean), {"mean": mean})


def test_inference_says_how_many_of_the_simulations_are_done():
    told = Noting()
    infer(blurred_mean, torch.tensor(1.0), backend="abc", num_simulations=50, progress=told)
    (label,) = [label for label in told.told if label.endswith("simulate")]
    first, *_, last = told.told[label]
    assert first == (0.0, "0 of 50 simulations") and last == (1.0, "50 of 50 simulations")
    fractions = [fraction for fraction, _ in told.told[label]]
    assert all(a <= b for a, b in itertools.pairwise(fractions))
