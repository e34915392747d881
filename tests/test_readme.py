"""The README's Python runs as printed."""

import re
from pathlib import Path

import numpy as np
import pytest

from npdr_ppl.rollouts import Rollouts

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.slow
def test_the_readmes_example_runs(tmp_path, monkeypatch, capsys):
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
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    scope: dict[str, object] = {}
    exec(compile(example, str(README), "exec"), scope)
    assert scope["trajectories"].shape == (200, 1, 100, 2)  # type: ignore[attr-defined]
    assert "–" in capsys.readouterr().out


def test_lines_of_the_readme_are_short():
    for line in README.read_text().splitlines():
        assert len(line) <= 100, line
