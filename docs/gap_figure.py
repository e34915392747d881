"""Draws the README's figure: the gap to the real Furuta pendulum, before and after discovery.

It needs the paper's recordings and a finished search in them::

    npdr reproduce missing-effect --data quanser_qube --out reproduction
    python docs/gap_figure.py quanser_qube reproduction/missing-effect docs/images/gap.svg
"""

import json
import re
import runpy
import sys
from pathlib import Path

import torch
from matplotlib import rc_context
from matplotlib.figure import Figure

from npdr_ppl.drawing.theme import theme
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.preparation.binding import DataOptions
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.reproduction.missing_effect import load_recordings
from npdr_ppl.reproduction.table2 import SEGMENT_LENGTH

INK, FAINT, BEFORE, AFTER = "#1f2328", "#8c959f", "#d1610a", "#0a7bc4"
ON_DARK = {INK: "#e6edf3", FAINT: "#7d8590", BEFORE: "#f08a3c", AFTER: "#58a6ff"}
"""What each colour becomes where the reader's pages are dark."""

SHOWN = {"pole_angle": "pole angle\n[rad]", "pole_velocity": "error of pole\nvelocity [rad/s]"}


def main(data, search, out):
    """Draws ``out`` from the recordings in ``data`` and the result in ``search``."""
    torch.set_num_threads(1)
    result = json.loads((Path(search) / "missing-effect.json").read_text())
    swing_ups, _ = load_recordings(Path(data))
    rollout = swing_ups[[result["held_out"][0]]]
    revised = runpy.run_path(str(Path(search) / "revised_model.py"))["revised_model"]
    replays = {
        name: simulated(model, rollout, result["closest_fit"][name])
        for name, model in (("refitted", furuta), ("revised", revised))
    }
    settings = {"svg.fonttype": "path", "svg.hashsalt": "gap", "font.size": 9}
    with theme(), rc_context(settings):
        figure = Figure(figsize=(9.2, 3.4), layout="constrained")
        left, right = figure.subfigures(1, 2, width_ratios=(2.3, 1))
        draw_rollout(left, rollout, replays)
        draw_errors(right, result["rows"])
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    readable_on_dark(Path(out))


def simulated(model, rollout, values):
    """Returns what a model reports along a rollout, ``(T, C)``, and the names of the channels."""
    options = DataOptions(None, SEGMENT_LENGTH, "estimated", "float64")
    parameters = {n: torch.tensor([v], dtype=torch.float64) for n, v in values.items()}
    found = replay(model, rollout, parameters, options)
    return found.series()[0][0].double().numpy()


def draw_rollout(figure, rollout, replays):
    """Draws the pole's angle, and how far both models' velocities are from the recorded ones."""
    names = [sensor.name for sensor in Furuta.sensors]
    measured = rollout.series(tuple(names))[0].numpy()
    time = rollout.time[0][:-1]
    top, bottom = figure.subplots(2, 1, sharex=True)
    column = names.index("pole_angle")
    top.plot(time, measured[:, column], color=INK, lw=2.2, label="measured")
    for name, color, label in (
        ("refitted", BEFORE, "simulated, fitted parameters"),
        ("revised", AFTER, "and the effects that were found"),
    ):
        top.plot(time, replays[name][:, column], color=color, lw=1.1, label=label)
        error = (replays[name] - measured)[:, names.index("pole_velocity")]
        bottom.plot(time, error, color=color, lw=1.1)
    bottom.axhline(0.0, color=INK, lw=0.6)
    for axis, label in zip((top, bottom), SHOWN.values(), strict=True):
        axis.set_ylabel(label)
        axis.set_xlim(time[0], time[-1])
        recolour(axis)
    bottom.set_xlabel("time in a swing-up that neither model was fitted to [s]")
    figure.legend(
        *top.get_legend_handles_labels(), loc="outside upper center", ncols=3, labelcolor=INK
    )


def draw_errors(figure, rows):
    """Draws the errors on held-out recordings of both kinds, relative to nominal parameters."""
    axis = figure.subplots()
    bars = (("nominal", FAINT), ("refitted", BEFORE), ("revised", AFTER))
    kinds = {"rmse": "swing-ups", "rmse_chirp": "chirps"}
    for k, kind in enumerate(kinds):
        for b, (name, color) in enumerate(bars):
            height = rows[name][kind]["mean"]
            axis.bar(k + 0.27 * (b - 1), height, 0.24, color=color)
            label = f"{name}\n{height:.3f}" if k == 0 else f"{height:.3f}"
            axis.text(
                k + 0.27 * (b - 1), height, label, ha="center", va="bottom", color=INK, size=7.5
            )
    axis.set_xticks(range(len(kinds)), kinds.values())
    axis.set_ylabel("RMSE on held-out recordings")
    axis.set_ylim(0.0, 1.15 * rows["nominal"]["rmse"]["mean"])
    recolour(axis)


def recolour(axis):
    """Gives an axis the colours that turn with the page."""
    axis.tick_params(colors=INK)
    for part in (axis.xaxis.label, axis.yaxis.label):
        part.set_color(INK)
    for spine in axis.spines.values():
        spine.set_color(INK)


def readable_on_dark(path):
    """Adds a style sheet that lightens the colours where the reader's pages are dark."""
    rules = "".join(
        f'[style*="{kind}: {old}"]{{{kind}:{new}!important}}'
        for old, new in ON_DARK.items()
        for kind in ("stroke", "fill")
    )
    style = f"<style>@media (prefers-color-scheme: dark){{{rules}}}</style>"
    text = re.sub(r"(<svg\b[^>]*>)", lambda m: m[1] + style, path.read_text(), count=1)
    path.write_text("\n".join(line.rstrip() for line in text.splitlines()) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
