"""The Python of the README and of every page of the documentation runs as printed.

The blocks of a page are one program, run in an empty folder that holds ``measured.csv``.
"""

import re
import tomllib
from pathlib import Path

import numpy as np
import pyro
import pytest
import torch

from npdr_ppl.rollouts import Rollouts

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {"bring_your_simulator.md"}
"""Pages whose programs need files around them; tests of their own run them."""

BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def programs():
    """Returns the blocks of every page that has any, each behind as many lines as on the page."""
    found = {}
    for page in PAGES:
        text = page.read_text()
        blocks = [(text[: m.start(1)].count("\n"), m.group(1)) for m in BLOCK.finditer(text)]
        if blocks and page.name not in ELSEWHERE:
            found[page] = blocks
    return found


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """A recording of a pendulum, in the present folder."""
    time = 0.02 * np.arange(101)
    torque = np.sin(2 * np.pi * time)
    angle = 0.3 * np.sin(2 * np.pi * time)
    velocity = np.gradient(angle, time)
    Rollouts.from_arrays(
        readings=[np.stack([angle, velocity], -1)],
        actions=[torque[:-1, None]],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    ).to_csv(tmp_path / "measured.csv")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("page", programs(), ids=lambda page: page.name)
@pytest.mark.usefixtures("measured")
def test_the_pages_program_runs(page):
    torch.manual_seed(0)
    pyro.clear_param_store()
    scope: dict[str, object] = {"__name__": "page"}
    for line, block in programs()[page]:
        # Empty lines in front, so that an error names the line of the page.
        exec(compile("\n" * line + block, str(page), "exec"), scope)
    if page.name == "README.md":
        assert scope["trajectories"].shape == (200, 1, 100, 2)  # type: ignore[attr-defined]


def test_lines_of_the_readme_are_short():
    for line in (ROOT / "README.md").read_text().splitlines():
        # A row of a table cannot be broken.
        assert len(line) <= 100 or line.startswith("|"), line


def test_every_page_is_in_the_navigation_once():
    sections = tomllib.loads((ROOT / "docs" / "navigation.toml").read_text())["section"]
    listed = [name for section in sections for _, name in section["pages"]]
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert sorted(listed) == sorted(pages - {"index.md"})
