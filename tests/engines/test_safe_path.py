"""Helper processes never import modules from the current folder, such as a downloads folder."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from npdr_ppl.engines.workers.safe_path import inherited_environment, safe_path
from npdr_ppl.rollouts import Rollouts
from tests.helpers.pendulum_recordings import swinging

ROOT = Path(__file__).parents[2]

STOLEN = (
    "cloudpickle", "ctypes", "distributed", "joblib", "json", "msgpack", "multiprocessing",
    "npdr_ppl", "numpy", "pickle", "pyro", "ray", "socket", "torch", "zlib",
)  # fmt: skip
"""Names of modules that helper processes import."""

POOL = """
import socket
import sys
from importlib.util import find_spec

from npdr_ppl.engines.workers import Pool, WorkerOptions
from tests.helpers.pool_tasks import Noise

if __name__ == "__main__":
    number = None if sys.argv[1] == "serial" else 2
    with Pool(WorkerOptions(sys.argv[1], number, chunk_size=2)) as pool:
        assert len(pool.run(Noise(), range(6), seed=7).values) == 6
        if find_spec("psutil") is None:
            sys.exit()
        import psutil

        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        print(len(family))
        for process in family:
            for place in process.net_connections("inet"):
                is_datagram = place.type == socket.SOCK_DGRAM
                if place.status == psutil.CONN_LISTEN or (is_datagram and not place.raddr):
                    print(place.laddr.ip)
"""
"""Runs some draws; prints the number of processes and the addresses at which they listen."""


OWN_MODEL = """
import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from tests.helpers.pooled_models import Drift


def model(inputs):
    gain = pyro.sample("gain", dist.Uniform(0.5, 2.0))
    return npdr.simulate("trajectory", Drift(0.0), {"gain": gain}, inputs, noise={"level": 0.1})
"""
"""A simulator that runs on the workers."""


def drifting():
    """Returns two rollouts of a level with gain 1.2."""
    pushes = np.random.default_rng(0).normal(size=(2, 60, 1))
    levels = np.concatenate([np.zeros((2, 1, 1)), 1.2 * pushes.cumsum(1)], 1)
    return Rollouts.from_arrays(
        readings=list(levels + 0.1 * np.random.default_rng(1).normal(size=levels.shape)),
        actions=list(pushes),
        channel_names=("level",),
        action_names=("push",),
        time_step=0.1,
    )


@pytest.fixture
def hostile(tmp_path):
    """A folder with modules that leave a file in ``ran`` when they are imported."""
    folder, ran = tmp_path / "downloads", tmp_path / "ran"
    folder.mkdir()
    ran.mkdir()
    for name in STOLEN:
        (folder / f"{name}.py").write_text(f"open({str(ran / name)!r}, 'w').close()\n")
    return folder


def ran(folder):
    return sorted(file.name for file in (folder.parent / "ran").iterdir())


def run(folder, *command):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    environment |= {"PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0"}
    return subprocess.run(
        [sys.executable, "-P", *command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


def test_the_folder_would_be_imported_from_without_protection(hostile):
    subprocess.run([sys.executable, "-c", "import json, joblib"], cwd=hostile, check=False)
    assert ran(hostile) == ["joblib", "json"]


def executor(name, package=None):
    missing = package is not None and find_spec(package) is None
    marks = (pytest.mark.slow, pytest.mark.skipif(missing, reason=f"{package} is not installed"))
    return pytest.param(name, marks=marks if package else ())


@pytest.mark.parametrize(
    "name",
    [
        executor("serial"),
        executor("threads"),
        executor("loky"),
        executor("dask", "distributed"),
        executor("ray", "ray"),
    ],
)
def test_workers_import_nothing_from_the_current_folder_and_listen_on_loopback_only(
    hostile, tmp_path, name
):
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    done = run(hostile, str(script), name)
    assert done.returncode == 0, done.stderr[-2000:]
    assert ran(hostile) == []
    if find_spec("psutil") is None:
        pytest.skip("without psutil, only their imports are tested, not where they listen")
    number, *places = done.stdout.split()
    if name in ("serial", "threads"):  # in the process itself
        assert not places
        return
    assert int(number) > 2
    assert set(places) <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    if name != "loky":  # which uses pipes
        assert places


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("fit", "own.py:model", "--backend", "abc", "--initial-state", "recorded",
         "--simulations", "60", "--workers", "2", "--out", "fit"),
        ("compare", "pendulum", "--backends", "abc,bayesian-linear-regression", "--simulations",
         "60", "--workers", "2", "--out", "compare"),
        ("discover", "pendulum", "--candidates", "hinge.coulomb_friction,hinge.spring",
         "--workers", "2", "--out", "found"),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_commands_import_nothing_from_the_folder_of_a_recording(hostile, command):
    word, model, *options = command
    rollouts = swinging(rollouts=2, steps=100) if model == "pendulum" else drifting()
    rollouts.to_csv(hostile / "recording.csv")
    (hostile / "own.py").write_text(OWN_MODEL)
    done = run(
        hostile, "-c", "from npdr_ppl.cli.main import main; main()", word, model,
        "--data", "recording.csv", *options,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert ran(hostile) == []


def test_a_simulator_may_start_scripts_that_import_what_lies_beside_them(tmp_path, monkeypatch):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with safe_path():
        assert os.environ["PYTHONSAFEPATH"] == "1"
        assert not {"PYTHONSAFEPATH", "NPDR_ADDED_SAFE_PATH"} & set(inherited_environment())
    assert "PYTHONSAFEPATH" not in os.environ
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    with safe_path():
        assert inherited_environment()["PYTHONSAFEPATH"] == "1"
