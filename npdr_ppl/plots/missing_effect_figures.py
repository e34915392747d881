"""The figures of the real Furuta pendulum's missing effects."""

from pathlib import Path

from npdr_ppl.plots.bands import plot_bands
from npdr_ppl.plots.discovery_figures import write_discovery_figures
from npdr_ppl.plots.latent_force import BEFORE
from npdr_ppl.plots.theme import save_figure
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.discovery import Discovery
from npdr_ppl.workflows.discovery.credible import parameter_density
from npdr_ppl.workflows.evaluation import replay
from npdr_ppl.workflows.missing_effect import CHIRP_SEGMENT_LENGTH
from npdr_ppl.workflows.table2 import SEGMENT_LENGTH

__all__ = ["write_missing_effect_figures"]

NUM_PREDICTIVE = 40


def write_missing_effect_figures(
    discovery: Discovery, held_out: Rollouts, chirps: Rollouts | None, out: Path
) -> list[Path]:
    """Draws the discovery, and both models' predictions for recordings that neither has seen.

    Args:
        discovery: The discovery.
        held_out: Held-out swing-ups, of which the first is drawn.
        chirps: Rollouts of the other excitation, likewise.
        out: Folder for the figures of a discovery, ``held_out.png`` and ``chirp.png``.
    """
    paths = write_discovery_figures(discovery, out)
    shown = {"held_out": (held_out, SEGMENT_LENGTH)}
    if chirps is not None:
        shown["chirp"] = (chirps, CHIRP_SEGMENT_LENGTH)
    start, final = discovery.search.rounds[0].hypothesis, discovery.search.final
    prior = final.segments.prior
    with seeded(discovery.options.seed, "discovery", "bands"):
        draws = prior.to_parameters(parameter_density(final).sample(NUM_PREDICTIVE).double())
    single = {name: value[None] for name, value in start.parameters.items()}
    for name, (rollouts, length) in shown.items():
        one = rollouts[[0]]
        options = BindingOptions(None, length, "estimated", "float64")
        after, before = (
            replay(final.model, one, draws, options),
            replay(start.model, one, single, options),
        )
        channels = after.channel_names
        figure = plot_bands(
            one.time[0][:-1],
            one.series(channels)[0].numpy(),
            after.series()[0].double().numpy(),
            channel_names=channels,
            units=[one.channel_units[one.channel_names.index(c)] for c in channels],
            lines={BEFORE: before.series()[0][0].double().numpy()},
            resets=after.inputs.start.double().numpy() * one.time_step,
        )
        paths.append(save_figure(figure, out / f"{name}.png"))
    return paths
