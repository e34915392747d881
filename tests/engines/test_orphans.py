"""No process of a run outlives the run by more than ten seconds, however the run ends."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer

from npdr_ppl.cli.main import main, run
from npdr_ppl.cli.manners import Commands, Stopped, resumable, stop_on_signals
from npdr_ppl.engines.workers import Pool, WorkerOptions
from npdr_ppl.engines.workers.guard import guarded_cluster
from tests.helpers.pool_tasks import StartsPrograms

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tests" / "helpers" / "stop_runs.py"

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc and prctl")


def executor(name, package=None):
    missing = package is not None and find_spec(package) is None
    return pytest.param(
        name, marks=pytest.mark.skipif(missing, reason=f"{package} is not installed")
    )


@on_linux
@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        executor("serial"),
        executor("loky"),
        executor("dask", "distributed"),
    ],
)
def test_a_stopped_fit_leaves_no_process(tmp_path, name):
    # Two minutes, for very busy machines; otherwise it takes seconds. Without a watch on its
    # parent, a worker of loky lives for five minutes. With seed 117 the signals come some
    # seconds after the first worker; benchmarks/stopped_runs.py takes any moment.
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path), name, "2", "117", "120"],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["left"] for row in rows] == [[]] * 2
    assert any(row["running"] > 2 for row in rows)  # there was something to leave
    for row in rows:
        assert row["was_alive"]
        if row["signal"] == "SIGTERM":
            assert row["exit_code"] == 128 + signal.SIGTERM
            assert "npdr: interrupted" in row["errors"]


def is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@on_linux
@pytest.mark.parametrize("ending", ["hangs", "crashes", "raises", "returns"])
def test_programs_that_a_simulation_started_end_with_it(tmp_path, ending):
    with Pool(WorkerOptions("serial", time_limit=2.0, retries=0)) as pool:
        outcome = pool.run(StartsPrograms(str(tmp_path)), [ending, "starts none"])
        programs = [int(file.name) for file in tmp_path.iterdir()]
        assert len(programs) == 2
        if ending == "returns":  # the simulation may use them again in its next draw
            assert all(is_running(program) for program in programs)
            assert not outcome.faults
        else:
            assert outcome.faults.lost == (0,)
            assert not any(is_running(program) for program in programs)
    assert not any(is_running(program) for program in programs)


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_stops_a_command_like_ctrl_c(capsys, name, code):
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with stop_on_signals(), pytest.raises(SystemExit) as stop:
            try:
                with resumable("do it again."):
                    os.kill(os.getpid(), number)
                    time.sleep(10.0)
            except Exception as error:  # what typer does with it
                sys.exit(error.exit_code)
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert stop.value.code == code
    assert capsys.readouterr().err == "npdr: interrupted; do it again.\n"


class StopsInFinaliser:
    """Python drops what a finaliser raises."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)


def test_a_signal_that_python_drops_comes_again(capsys):
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with stop_on_signals(), pytest.raises(Stopped):
            finalised = StopsInFinaliser()
            del finalised
            time.sleep(10.0)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == ""


def test_an_error_that_follows_an_interruption_is_not_hidden_by_it():
    with pytest.raises(OSError, match="cannot be switched off"), resumable("do it again."):
        try:
            raise KeyboardInterrupt
        finally:
            raise OSError("The device cannot be switched off.")


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stop_on_signals():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def ended(monkeypatch, command):
    """Runs the program with one command, which a signal ends; returns its exit code."""
    app = typer.Typer(cls=Commands, add_completion=False)
    app.callback()(lambda: None)
    app.command("wait")(command)
    monkeypatch.setattr("npdr_ppl.cli.main.app", app)
    monkeypatch.setattr("sys.argv", ["npdr", "wait"])
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stop:
            main()
    finally:
        signal.signal(signal.SIGTERM, before)
    return stop.value.code


def test_a_signal_where_nothing_was_begun_gets_a_sentence(capsys, monkeypatch):
    def wait():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10.0)

    assert ended(monkeypatch, wait) == 143
    assert capsys.readouterr().err == "npdr: interrupted.\n"


def test_an_interruption_that_ray_replaces_keeps_its_exit_code(capsys, monkeypatch):
    def wait():
        with resumable("do it again."):
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(10.0)
            except KeyboardInterrupt:  # Ray lets nothing else end a call, and raises a new one
                raise KeyboardInterrupt from None

    assert ended(monkeypatch, wait) == 143
    assert capsys.readouterr().err == "npdr: interrupted; do it again.\n"


def test_an_interruption_that_compiled_code_disguised_is_one(capsys, monkeypatch):
    def wait():
        with resumable("do it again."):
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(10.0)
            except Stopped as error:
                raise SystemError("returned a result with an exception set") from error

    assert ended(monkeypatch, wait) == 143
    assert capsys.readouterr().err == "npdr: interrupted; do it again.\n"
    with pytest.raises(SystemError, match="another"), resumable("do it again."):
        raise SystemError("another")


def test_an_interrupted_program_ends_at_once(monkeypatch):
    def interrupted():
        sys.exit(143)

    def leave(code):
        raise TimeoutError(code)

    monkeypatch.setattr("npdr_ppl.cli.main.main", interrupted)
    monkeypatch.setattr("npdr_ppl.cli.main.os._exit", leave)
    monkeypatch.setattr("npdr_ppl.cli.main.logging.shutdown", lambda: None)
    with pytest.raises(TimeoutError, match="143"):
        run()


def orphan(*words):
    """Starts a program that sleeps and whose parent has ended; returns its process number."""
    code = (
        "import subprocess, sys;"
        "print(subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL).pid, flush=True)"
    )
    sleep = [sys.executable, "-c", "import time; time.sleep(60)", *words]
    started = subprocess.run(
        [sys.executable, "-c", code, *sleep], stdout=subprocess.PIPE, check=True, text=True
    )
    return int(started.stdout)


def has_ended(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


@on_linux
def test_ray_workers_end_with_their_cluster_although_nothing_links_them_to_it():
    session = "/tmp/ray/session_2026-01-02_03-04-05_678901_23"
    sleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    late, other = orphan("/ray/_private/worker.py", session), orphan("/ray/_private/worker.py")
    with subprocess.Popen([*sleep, "/ray/core/raylet", session]) as cluster:
        with guarded_cluster():
            time.sleep(2.0)
        assert cluster.wait(5.0) == -signal.SIGKILL
    try:
        assert has_ended(late) and not has_ended(other)
    finally:
        os.kill(other, signal.SIGKILL)
