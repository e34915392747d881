"""The figures of a discovery."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery import Discovery, Investigation
from npdr_ppl.discovery.discovery_folder import STAGES, Stage
from npdr_ppl.discovery.discovery_view import short_name
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.parameter_intervals import Draws, quick_draws
from npdr_ppl.display.plots.comparison_panels import plot_overlaid_marginals
from npdr_ppl.display.plots.discovery_panels import plot_gap, plot_ranking, plot_separation
from npdr_ppl.display.plots.fit_figures import scalar_columns
from npdr_ppl.display.plots.latent_force_figure import AFTER, BEFORE, plot_latent_force
from npdr_ppl.display.plots.learned_law_figure import plot_learned_law
from npdr_ppl.display.plots.residual_map_figure import plot_residual_map
from npdr_ppl.drawing.theme import save_figure
from npdr_ppl.randomness import seeded

__all__ = ["write_discovery_figures", "write_stage_figures"]

NUM_DRAWS = 2_000

Columns = dict[str, NDArray[np.float64]]


def write_discovery_figures(discovery: Discovery, out: Path) -> list[Path]:
    """Draws the residuals of the model, the missing effects, and the improvement by adding them.

    Args:
        discovery: The discovery.
        out: Folder for ``residual_map.png``, ``latent_force.png``, ``ranking.png``,
            ``separation.png``, ``parameters.png`` and, where there are effects or held-out
            rollouts or a learned law, ``effects.png``, ``gap.png`` and ``learned_law.png``.
    """
    rounds, final = discovery.search.rounds, discovery.final
    first, last = rounds[0], rounds[-1]
    start = first.hypothesis
    after = final if final.effects else None
    figures = {
        "residual_map": plot_residual_map(start, after, discovery.where),
        "latent_force": plot_latent_force(first, last, _channel_units(start)),
        "ranking": plot_ranking(discovery.ranking, discovery),
    }
    if discovery.separation_names:
        matrix = discovery.separation.numpy()
        figures["separation"] = plot_separation(matrix, discovery.separation_names)
    seed = discovery.seed
    units = {name: estimate.unit for name, estimate in discovery.parameters.items()}
    drawn = discovery.draws
    if after is not None:
        drawn = quick_draws(start, seed=seed)
    prior, draws = _draws(start, drawn, seed)
    posteriors = {BEFORE: draws}
    if after is not None:
        wide, narrow = _draws(after, discovery.draws, seed)
        # The revised model comes first, so that it has the same colour as in the other figures.
        posteriors = {AFTER: {name: narrow[name] for name in draws}, **posteriors}
        new = [name for name in narrow if name not in draws]
        figures["effects"] = plot_overlaid_marginals(
            {AFTER: {_label(name): narrow[name] for name in new}},
            {_label(name): wide[name] for name in new},
            units={_label(name): units.get(name, "") for name in new},
        )
    figures["parameters"] = plot_overlaid_marginals(posteriors, prior, units=units)
    if discovery.gap:
        figures["gap"] = plot_gap(discovery.gap)
    if discovery.learned is not None:
        figures["learned_law"] = plot_learned_law(discovery.learned)
    return [save_figure(f, out / f"{name}.png") for name, f in figures.items() if f is not None]


def write_stage_figures(investigation: Investigation, stage: Stage, out: Path) -> list[Path]:
    """Draws the results after a stage that precedes the naming of effects.

    Args:
        investigation: The investigation.
        stage: The last stage.
        out: Folder for ``residual_map.png``, ``latent_force.png``, ``ranking.png`` and
            ``separation.png``, if their stage was reached.
    """
    reached = STAGES.index(stage)
    figures = {}
    if reached >= STAGES.index("locate"):
        figures["residual_map"] = plot_residual_map(investigation.start, where=investigation.where)
    if reached >= STAGES.index("alarm"):
        first = investigation.first
        figures["latent_force"] = plot_latent_force(
            first, units=_channel_units(investigation.start)
        )
        figures["ranking"] = plot_ranking(first.ranking)
        if first.ranking:
            names = [candidate.name for candidate in first.ranking]
            matrix = first.separation.numpy()
            figures["separation"] = plot_separation(matrix, names[: len(matrix)])
    return [save_figure(f, out / f"{name}.png") for name, f in figures.items() if f is not None]


def _channel_units(hypothesis: Hypothesis) -> dict[str, str]:
    simulator = hypothesis.simulator
    return {c.name: c.unit for c in (*simulator.sensors, *simulator.actions)}


def _label(site: str) -> str:
    """Returns the name of an effect's parameter in lines short enough for a panel."""
    name, _, parameter = site.rpartition(".")
    return f"{short_name(name)}\n{parameter.replace('_', ' ')}"


def _draws(hypothesis: Hypothesis, draws: Draws, seed: int) -> tuple[Columns, Columns]:
    """Returns draws of prior and posterior by scalar parameter."""
    prior = hypothesis.segments.prior
    with seeded(seed, "discovery", "figures"):
        before = prior.to_parameters(prior.sample(NUM_DRAWS))
        after = prior.to_parameters(draws.resampled(NUM_DRAWS))
    return scalar_columns(before), scalar_columns(after)
