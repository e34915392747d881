"""The pool: equal results everywhere, and faults that cost only the draws they hit."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.engines.workers import Faults, Pool, WorkerOptions
from npdr_ppl.errors import ModelError, SimulationError
from tests.helpers.faulty import FaultRates, Faulty
from tests.helpers.pool_tasks import (
    CountSetUps,
    FailsToLoad,
    FailsToSetUp,
    Noise,
    Orphan,
    Parent,
    Raises,
    Refuses,
)

# Far longer than a draw of these tests takes on a busy machine.
TIME_LIMIT = 2.0


def serial(**options):
    return Pool(WorkerOptions("serial", time_limit=TIME_LIMIT, **options))


def expected(num_draws):
    """What Noise returns, computed here: NumPy's generator under the draws' seeds."""
    from npdr_ppl.randomness import derived_seed

    return np.array(
        [
            np.random.default_rng(derived_seed(7, "draw", i)).normal(i, size=3)
            for i in range(num_draws)
        ]
    )


@pytest.mark.parametrize(
    "options",
    [
        WorkerOptions("serial", chunk_size=7),
        WorkerOptions("threads", 3, chunk_size=1),
        WorkerOptions("loky", 2, chunk_size=5),
        WorkerOptions("loky", 1),
    ],
    ids=str,
)
def test_results_depend_on_nothing_but_draws_and_seed(options):
    reports = []
    with Pool(options) as pool:
        outcome = pool.run(
            Noise(), range(50), seed=7, progress=lambda done, status: reports.append(done)
        )
    np.testing.assert_array_equal(np.array(outcome.values), expected(50))
    assert not outcome.faults
    assert outcome.faults.num_draws == 50
    assert reports == sorted(reports)
    assert reports[-1] == 1.0


@pytest.mark.slow
def test_faults_cost_only_the_draws_they_hit():
    rates = FaultRates(crash=0.06, hang=0.03, nan=0.06)
    with Pool(WorkerOptions("threads", 2, time_limit=TIME_LIMIT)) as pool:
        cured = pool.run(Faulty(Noise(), rates), range(100), seed=7)
        lasting = FaultRates(rates.crash, 0.0, rates.nan, times=2)
        lost = pool.run(Faulty(Noise(), lasting), range(100), seed=7)
    # A retry has the same seed, so a fault that passes leaves no trace in the results.
    np.testing.assert_array_equal(np.array(cured.values), expected(100))
    counts = cured.faults.counts()
    assert counts["crashed"] and counts["hung"] and counts["nan"]
    assert counts["crashed"] + counts["hung"] + counts["nan"] == counts["retried"]
    assert counts["lost"] == 0
    failed = {index for index, value in enumerate(lost.values) if value is None}
    assert failed == set(lost.faults.lost) and len(failed) > 5
    assert lost.faults.counts()["crashed"] == 2 * len(set(lost.faults.crashed))
    for index, value in enumerate(lost.values):
        if value is not None:
            np.testing.assert_array_equal(value, expected(100)[index])


def test_a_process_serves_many_draws_until_one_fails(tmp_path):
    payloads = ["fine", "fine", "fail", "fine"]
    with serial(chunk_size=4) as pool:
        first = pool.run(CountSetUps(str(tmp_path)), payloads)
        again = pool.run(CountSetUps(str(tmp_path)), ["fine"] * 4)
    # Two draws, the failure, then the rest and the retry in another process.
    assert [int(value[0]) for value in first.values] == [1, 2, 2, 1]
    # The same task finds the process that the last run left.
    assert [int(value[0]) for value in again.values] == [3, 4, 5, 6]
    assert len(list(tmp_path.iterdir())) == 2


def test_errors_are_counted_and_quoted():
    with serial() as pool:
        outcome = pool.run(Raises(), [1, -1, 2])
        assert outcome.values[1] is None
        assert outcome.faults.raised == (1, 1)
        assert "below zero" in str(outcome.faults)
        with pytest.raises(SimulationError, match="Every simulation.*below zero"):
            pool.run(Raises(), [-1, -2])


@pytest.mark.parametrize(
    ("task", "error", "words"),
    [
        (Refuses(), ModelError, "no joint 'elbow'"),
        (FailsToSetUp(crashes=False), SimulationError, "no engine here"),
        (FailsToSetUp(crashes=True), SimulationError, "3 times in a row"),
        (FailsToLoad(), SimulationError, "this module is broken"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_no_draw_can_survive_ends_the_run(task, error, words):
    with serial() as pool:
        with pytest.raises(error, match=words):
            pool.run(task, range(3))
        # The pool is as good as new.
        np.testing.assert_array_equal(pool.run(Noise(), range(3), seed=7).values, expected(3))


def test_draws_are_consumed_as_they_are_needed():
    consumed = []

    def payloads():
        for number in range(1_000):
            consumed.append(number)
            yield number

    with serial(chunk_size=1) as pool:
        stream = pool.stream(Noise(), payloads(), seed=7)
        first = next(stream)
        assert list(first.values) == [0]
        assert len(consumed) <= 100
        stream.close()


@pytest.mark.slow
def test_an_executor_that_breaks_is_replaced():
    with Pool(WorkerOptions("loky", 2, chunk_size=2)) as pool:
        template = int(pool.run(Parent(), [None]).values[0][0])
        # The kernel kills a worker, for want of memory say: not its child, but the worker itself.
        worker = int(Path(f"/proc/{template}/stat").read_text().rpartition(")")[2].split()[1])
        os.kill(worker, signal.SIGKILL)
        outcome = pool.run(Noise(), range(8), seed=7)
    np.testing.assert_array_equal(np.array(outcome.values), expected(8))
    # Nothing of the killed worker is left.
    wait_for(lambda: not is_alive(template), 10.0)


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's prctl")
def test_a_draw_ends_with_its_template():
    with Pool(WorkerOptions("serial", time_limit=60.0, retries=0)) as pool:
        outcome = pool.run(Orphan(), [10.0])
    assert outcome.values == [None] and outcome.faults.crashed == (0,)


@pytest.mark.parametrize("executor", ["loky", "threads", "serial"])
def test_an_interrupt_ends_all_processes(tmp_path, executor):
    here = Path(__file__).parents[2]
    script = (
        "import signal\n"
        # Where the tests run in the background, a shell has told them to ignore interrupts.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import npdr_ppl as npdr\n"
        "from tests.helpers.pool_tasks import Sleep\n"
        "if __name__ == '__main__':\n"
        f"    with npdr.workers({executor!r}) as used:\n"
        f"        used.pool.run(Sleep({str(tmp_path)!r}), [60.0] * 4)\n"
    )
    (tmp_path / "script").mkdir()
    file = tmp_path / "script" / "run.py"
    file.write_text(script)
    run = subprocess.Popen(
        [sys.executable, str(file)], stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(here)},
    )  # fmt: skip

    def processes():
        return [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]

    wait_for(processes, 40.0)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=20.0)
    assert run.returncode != 0
    assert "KeyboardInterrupt" in errors
    wait_for(lambda: not any(is_alive(pid) for pid in processes()), 10.0)


def test_options_say_what_is_wrong():
    for options, words in (
        ({"executor": "slurm"}, "known are loky"),
        ({"num_workers": 0}, "at least 1"),
        ({"address": "tcp://here:1"}, "has no address"),
        ({"time_limit": 0.0}, "seconds"),
        ({"executor": "serial", "num_workers": 2}, "one worker"),
        ({"retries": -1}, "negative"),
    ):
        with pytest.raises(ModelError, match=words):
            WorkerOptions(**options)


def test_a_block_sums_up_its_faults():
    with npdr.workers("serial") as used:
        assert not used.is_used
    both = Faults(2, crashed=(1,), lost=(1,)) + Faults(3, nan=(0,), retried=(0,))
    assert both.counts() == {
        "draws": 5, "crashed": 1, "hung": 0, "nan": 1, "raised": 0, "retried": 1, "lost": 1
    }  # fmt: skip
    assert "1 crashed, 1 returned NaN" in str(both)


def wait_for(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def is_alive(pid):
    """Whether a process runs; one that nobody has reaped yet does not."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False
