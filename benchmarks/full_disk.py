"""Takes a fit's disk away in several ways, gives it back, and compares the resumed result.

    python benchmarks/full_disk.py --runs 100         # as root: a small file system in memory
    python benchmarks/full_disk.py --runs 20 --limit  # anyone: a limit on the size of files

The disk is full after a random number of bytes, read-only, or the folder is deleted while the fit
runs, or a second process fits into the same folder. Each fit must end with one sentence and exit
code 2, or with a result; afterwards the same command must give the result of an undisturbed fit.
Every fit is a fork of this process, so that libraries are imported once. The exit code is 1 if
anything else happened.
"""

import argparse
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import torch

from npdr_ppl.cli.main import main as npdr_main
from npdr_ppl.display.plots import fit_figures  # noqa: F401  (so that forks need not import it)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.helpers.pendulum_recordings import swinging  # noqa: E402

SIZE = 16 * 2**20
"""Bytes of the file system in memory: several times as many as a fit writes."""


class Disk:
    """A folder of which any number of bytes can be taken away.

    Args:
        folder: The folder; a file system in memory if it is one.
        is_mounted: Whether it is one.
    """

    def __init__(self, folder: Path, is_mounted: bool) -> None:
        self.folder, self.is_mounted = folder, is_mounted

    def leave(self, num_bytes: int) -> Callable[[], None]:
        """Leaves so many bytes free; returns what a fork must do for it first."""
        if not self.is_mounted:
            limits = num_bytes, resource.getrlimit(resource.RLIMIT_FSIZE)[1]
            return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        state = os.statvfs(self.folder)
        ballast = state.f_bavail * state.f_frsize - num_bytes
        with (self.folder / "ballast").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, ballast))
        return lambda: None

    def give_back(self) -> None:
        """Makes all bytes free again."""
        (self.folder / "ballast").unlink(missing_ok=True)


def start(data: Path, out: Path, before: Callable[[], None] = lambda: None) -> int:
    """Starts a fit in a fork; returns its process number."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        errors = os.open(data.parent / f"errors_{os.getpid()}", os.O_CREAT | os.O_WRONLY)
        os.dup2(errors, 2)
        sys.argv = [
            "npdr", "fit", "pendulum", "--data", str(data), "--out", str(out), "--quiet",
            "--backend", "abc", "--simulations", "20", "--segment-length", "25", "--embedding",
            "all/10", "--extra-rounds", "0", "--executor", "serial",
        ]  # fmt: skip
        before()
        npdr_main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def finish(data: Path, child: int) -> tuple[int, str]:
    """Returns the exit code of a fit and what it wrote to standard error."""
    _, status = os.waitpid(child, 0)
    file = data.parent / f"errors_{child}"
    errors = file.read_text()
    file.unlink()
    return os.waitstatus_to_exitcode(status), errors


def result(out: Path) -> str:
    """Returns the numbers of a fit."""
    found = json.loads((out / "fit.json").read_text())
    return json.dumps([found["parameters"], found["metrics"]])


def is_proper(code: int, errors: str) -> bool:
    """Returns whether a fit ended with its result, or with one sentence."""
    return code == 0 or (code == 2 and errors.startswith("npdr: ") and errors.count("\n") == 1)


def main() -> int:
    """Runs everything and prints what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", action="store_true", help="Limit files; mount nothing.")
    options = parser.parse_args()
    torch.set_num_threads(1)
    moments = random.Random(options.seed)
    wrong: list[str] = []
    counts = {"ended with a sentence": 0, "had room enough": 0}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        disk = Disk(folder / "disk", is_mounted=not options.limit)
        disk.folder.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(disk.folder)]
        if disk.is_mounted:
            subprocess.run(mount, check=True)
            stack.callback(subprocess.run, ["umount", str(disk.folder)], check=True)
        data, out = folder / "recording.csv", disk.folder / "fit"
        swinging(rollouts=2, steps=100).to_csv(data)

        def judge(what: str, code: int, errors: str) -> None:
            counts["ended with a sentence" if code == 2 else "had room enough"] += 1
            if not is_proper(code, errors):
                wrong.append(f"{what}: exit code {code}, {errors[-300:]}")

        def resume(what: str) -> None:
            code, errors = finish(data, start(data, out))
            if code or result(out) != expected:
                wrong.append(f"{what}, resumed: exit code {code}, {errors[-300:]}")
            shutil.rmtree(out)

        begun = time.perf_counter()
        code, errors = finish(data, start(data, folder / "undisturbed"))
        if code:
            raise SystemExit(errors)
        seconds = time.perf_counter() - begun
        expected = result(folder / "undisturbed")
        sizes = [f.stat().st_size for f in (folder / "undisturbed").rglob("*") if f.is_file()]
        most = sum(sizes) if disk.is_mounted else max(sizes)
        for _ in range(options.runs):
            num_bytes = moments.randrange(int(1.05 * most))
            what = f"{num_bytes} bytes"
            judge(what, *finish(data, start(data, out, disk.leave(num_bytes))))
            disk.give_back()
            resume(what)
        print(json.dumps(counts), flush=True)
        if disk.is_mounted:
            subprocess.run(["mount", "-o", "remount,ro", str(disk.folder)], check=True)
            judge("read-only", *finish(data, start(data, out)))
            subprocess.run(["mount", "-o", "remount,rw", str(disk.folder)], check=True)
        for _ in range(max(1, options.runs // 10)):
            child = start(data, out)
            moment = moments.uniform(0.0, seconds)
            time.sleep(moment)
            shutil.rmtree(out, ignore_errors=True)
            judge(f"deleted after {moment:.2f} s", *finish(data, child))
            resume(f"deleted after {moment:.2f} s")
            children = [start(data, out), start(data, out)]
            ends = [finish(data, child) for child in children]
            for code, errors in ends:
                judge("two at once", code, errors)
            if all(code == 2 for code, _ in ends):
                wrong.append(f"two at once, and none went on: {ends}")
            resume("two at once")
    print(json.dumps(counts), *wrong, f"{len(wrong)} wrong", sep="\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
