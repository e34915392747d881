"""Runs a recipe in Python with its defaults, and writes what the command line would.

    python benchmarks/clean_fits_recipe.py quick_start FOLDER OUT
    python benchmarks/clean_fits_recipe.py throw FOLDER OUT

FOLDER holds what :mod:`clean_fits_subjects` recorded; ``fit.json`` and ``posterior.nc`` go to OUT.
The quick start is run as its page prints it.
"""

import argparse
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pyro
import pyro.distributions as dist
import torch

import npdr_ppl as npdr
from npdr_ppl.arviz_module import to_netcdf
from npdr_ppl.posterior.diagnostics import Diagnosis

PAGE = Path(__file__).resolve().parents[1] / "docs" / "quick_start.md"

NOISE = 0.02
"""Standard deviation of the readings of a throw, in m."""


def quick_start(folder: Path) -> tuple[npdr.Posterior, Diagnosis]:
    """Runs the page's blocks as one program, beside a ``measured.csv``."""
    shutil.copy(folder / "rec.csv", folder / "measured.csv")
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    scope: dict[str, Any] = {"__name__": "page"}
    os.chdir(folder)
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), scope)
    return scope["posterior"], scope["diagnosis"]


def fly(speed, angle):
    """Returns range and height of a throw, in metres."""
    across, up = speed * torch.cos(angle), speed * torch.sin(angle)
    return torch.stack([2.0 * across * up / 9.81, up**2 / (2.0 * 9.81)], dim=-1)


def thrown():
    speed = pyro.sample("speed", dist.Uniform(1.0, 10.0))  # m/s
    angle = pyro.sample("angle", dist.Uniform(0.2, 1.4))  # rad
    return npdr.simulate("landing", fly, {"speed": speed, "angle": angle}, noise=NOISE)


def throw(folder: Path) -> tuple[npdr.Posterior, Diagnosis]:
    """Infers speed and angle of a throw with all defaults."""
    landing = torch.tensor(json.loads((folder / "truth.json").read_text())["observation"])
    posterior = npdr.infer(thrown, {"landing": landing})
    return posterior, npdr.diagnose(posterior.to_arviz())


RECIPES = {"quick_start": quick_start, "throw": throw}


def main() -> None:
    """Runs a recipe and writes its result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", choices=sorted(RECIPES))
    parser.add_argument("folder", type=Path, help="where the recording is")
    parser.add_argument("out", type=Path, help="where the result goes")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    posterior, diagnosis = RECIPES[arguments.recipe](arguments.folder.resolve())
    out.mkdir(parents=True, exist_ok=True)
    to_netcdf(posterior.to_arviz(), out / "posterior.nc")
    result = {
        "most_likely": {name: float(v) for name, v in posterior.most_likely().items()},
        "diagnosis": diagnosis.to_dict(),
    }
    (out / "fit.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
