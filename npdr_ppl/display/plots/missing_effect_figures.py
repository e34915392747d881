"""The figures of the real Furuta pendulum's missing effects."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.display.plots.discovery_figures import write_discovery_figures
from npdr_ppl.display.plots.latent_force_figure import AFTER, BEFORE, LOOKS
from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, save_figure, theme
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.reproduction.missing_effect import CHIRP_SEGMENT_LENGTH, Story
from npdr_ppl.reproduction.table2 import SEGMENT_LENGTH
from npdr_ppl.rollouts import Rollouts

__all__ = ["plot_replays", "write_missing_effect_figures"]


def write_missing_effect_figures(
    story: Story, held_out: Rollouts, chirps: Rollouts | None, out: Path
) -> list[Path]:
    """Draws the discovery, and the predictions of both models for held-out recordings.

    Args:
        story: The discovery and the models before and after.
        held_out: Held-out swing-ups, of which the first is drawn.
        chirps: Rollouts of the other excitation, of which the first is drawn.
        out: Folder for the figures of a discovery, ``held_out.png`` and ``chirp.png``.
    """
    paths = write_discovery_figures(story.discovery, out)
    shown = {"held_out": (held_out, SEGMENT_LENGTH)}
    if chirps is not None:
        shown["chirp"] = (chirps, CHIRP_SEGMENT_LENGTH)
    models = {BEFORE: story.refitted, AFTER: story.revised}
    for name, (rollouts, length) in shown.items():
        figure = plot_replays(models, rollouts[[0]], length)
        paths.append(save_figure(figure, out / f"{name}.png"))
    return paths


def plot_replays(models: Mapping[str, Hypothesis], rollouts: Rollouts, length: int) -> Figure:
    """Draws simulations of fitted models over one recorded rollout.

    Args:
        models: The models by legend entry.
        rollouts: One rollout.
        length: Steps between re-synchronisations.
    """
    options = DataOptions(None, length, "estimated", "float64")
    replays = {
        label: replay(h.model, rollouts, {n: v[None] for n, v in h.parameters.items()}, options)
        for label, h in models.items()
    }
    found = next(iter(replays.values()))
    units = {sensor.name: sensor.unit for sensor in Furuta.sensors}
    measured = rollouts.series(found.channel_names)[0].numpy()
    (time,) = rollouts.times_of_series
    with theme():
        figure = Figure(figsize=(7.5, 1.5 * len(units) + 0.4), layout="constrained")
        axes = figure.subplots(len(found.channel_names), 1, sharex=True, squeeze=False)[:, 0]
        for c, (axis, name) in enumerate(zip(axes, found.channel_names, strict=True)):
            for start in found.inputs.start.tolist():
                axis.axvline(start * rollouts.time_step, color="0.85", lw=0.6, zorder=0)
            axis.plot(time, measured[:, c], color=COLORS["measured"], lw=1.6, label="measured")
            for label, replayed in replays.items():
                series = replayed.series()[0][0, :, c].double().numpy()
                axis.plot(time, series, color=LOOKS[label], lw=0.9, label=label)
            axis.set_ylabel(f"{name}\n[{units[name]}]")
        axes[-1].set_xlabel("time [s]")
        axes[0].set_xlim(time[0], time[-1])
        add_legend(figure, loc="outside upper center", ncols=3)
    return figure
