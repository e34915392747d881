"""Reads a file or a folder of any format, and says what became of it."""

import contextlib
import io
import re
import sys
import traceback
import warnings
from pathlib import Path

from npdr_ppl.errors import DataError, NpdrError

MAX_SENTENCE = 600
"""Characters of the longest message that a person would still read."""

RECORDINGS = ("csv", "parquet", "npz", "nc")
LOGS = ("log_csv", "log_parquet", "h5", "mat", "mcap", "db3", "bag", "lerobot", "folder", "toml")
"""Logs of robots, and the mapping that says what they mean."""

FORMATS = (*RECORDINGS, "pickle", "mjcf", "urdf", "run", "resume", *LOGS)


def read(kind: str, path: Path) -> None:
    """Reads one file; errors are the caller's."""
    from npdr_ppl.rollouts import Rollouts

    if kind in RECORDINGS:
        Rollouts.load(path)
    elif kind == "toml":
        from npdr_ppl.rollouts.logs import Mapping

        Mapping.of(path)
    elif kind in LOGS:
        from npdr_ppl.rollouts.logs import read_log
        from npdr_ppl.rollouts.logs.inspection import described
        from npdr_ppl.rollouts.logs.mapping_template import mapping_to_start_from

        mapping_to_start_from(described(read_log(path)))
    elif kind == "pickle":
        Rollouts.from_simurlacra(path)
    elif kind == "mjcf":
        from npdr_ppl import MujocoSimulator

        MujocoSimulator(path).recorded_settings()
    elif kind == "urdf":
        from npdr_ppl.engines.bullet import BulletSimulator, Sensor
        from npdr_ppl.language.channels import Channel

        sensors = (Sensor(Channel("x", "m"), "body robot x"),)
        BulletSimulator(path, sensors=sensors).recorded_settings()
    elif kind == "run":
        command("report", str(path))
    elif kind == "resume":
        resume(path)
    else:
        raise AssertionError(kind)


def command(*words: str) -> None:
    """Runs `npdr` as a user would; anything but success or one sentence is an error."""
    from npdr_ppl.cli import main

    sys.argv = ["npdr", *words]
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main.main()
        except SystemExit as stop:
            code = stop.code or 0
    text = err.getvalue()
    if code == 2 and text.startswith("npdr: "):
        raise DataError(text.removeprefix("npdr: ").rstrip("\n"))
    if code or text:
        raise AssertionError(f"exit code {code}: {text}")


def resume(folder: Path) -> None:
    """Continues a small run of inference in a folder, or begins it."""
    import torch

    import npdr_ppl as npdr
    from npdr_ppl.inference.registry import backend

    npdr.infer(
        noisy_values,
        torch.tensor([0.3, 0.4]),
        backend=backend("snpe-c", transforms=1, hidden=(8,), epochs=2, members=1),
        num_simulations=50,
        rounds=2,
        checkpoint=folder,
        progress=False,
    )


def noisy_values() -> None:
    """A model with two parameters and a plain function."""
    import pyro
    import pyro.distributions as dist
    import torch

    import npdr_ppl as npdr

    place = pyro.sample("place", dist.Normal(0.0, 1.0))
    width = pyro.sample("width", dist.Uniform(0.1, 1.0))

    def simulator(place: torch.Tensor, width: torch.Tensor) -> torch.Tensor:
        both = torch.stack((place, width), -1)
        return both + 0.1 * torch.randn_like(both)

    npdr.simulate("x", simulator, {"place": place, "width": width})


def outcome(kind: str, path: Path) -> tuple[str, str]:
    """Reads one file; returns what happened and, unless it was read, the message."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read(kind, path)
        except NpdrError as error:
            message = str(error)
            is_sentence = (
                message.isprintable()
                and message.endswith((".", "?"))
                and len(message) <= MAX_SENTENCE
                and not re.search(r"\. [A-Z]", kind_of(message))
            )
            return ("refused" if is_sentence else "bad message"), message
        # Whatever else comes out is what the benchmark and the tests look for.
        except BaseException:
            return "traceback", traceback.format_exc()[-3000:]
    return "read", ""


def kind_of(message: str) -> str:
    """Returns a message without what is particular to one file."""
    message = re.sub(r"\S*/\S*", "…", message)
    message = re.sub(r"'[^']*'|\"[^\"]*\"", "'…'", message)
    message = re.sub(
        r"\b(x\d|u\d|θ|reward|rollout|time)\b(?= (is|was|reaches|goes))", "…", message
    )
    return re.sub(r"0x[0-9a-f]+|[-+]?\d[\d.e+-]*", "#", message)[:110]
