"""The figures of a fit: marginals, pairs, and predictive bands over the recording."""

from pathlib import Path
from typing import Any

from torch import Tensor

from npdr_ppl.display.plots.bands import nominal_line, plot_bands
from npdr_ppl.display.plots.marginals import plot_marginals
from npdr_ppl.display.plots.pair import plot_pair
from npdr_ppl.drawing.columns import scalar_columns
from npdr_ppl.drawing.theme import save_figure
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.posterior.posterior import PosteriorBase
from npdr_ppl.preparation.draw_budget import affordable_draws
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.preparation.sampling_settings import DRAW_BUDGET
from npdr_ppl.progress import Step
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts

__all__ = ["scalar_columns", "write_fit_figures"]

NUM_DRAWS = 2_000
NUM_PREDICTIVE = 100
MAX_PAIRS = 12
"""Maximum number of parameters of a pair plot; more panels would be too small to read."""


def write_fit_figures(
    posterior: PosteriorBase,
    model: Any,
    rollouts: Rollouts,
    out: Path,
    *,
    seed: int = 0,
    progress: Step | None = None,
) -> list[Path]:
    """Draws a posterior and its predictions for one rollout.

    Args:
        posterior: The posterior.
        model: The model without measurement noise, to draw only the simulator's spread.
        rollouts: The first of these is drawn.
        out: Folder for ``marginals.png``, ``pairs.png`` and ``bands.png``.
        seed: Seed of the draws.
        progress: Called with the fraction done and a short status.
    """
    step = progress or (lambda fraction, status: None)
    step(None, "marginals")
    draws = posterior.sample(NUM_DRAWS, seed=seed)
    prior = posterior.prior
    samples = scalar_columns(draws)
    with seeded(seed, "figures"):
        prior_samples = scalar_columns(prior.to_parameters(prior.sample(NUM_DRAWS)))
    most_likely = posterior.most_likely(seed=seed)
    marks = {"most likely": _values(most_likely)}
    paths = [
        save_figure(
            plot_marginals(
                samples, prior_samples, marks=marks, units=parameter_units(posterior.prior)
            ),
            out / "marginals.png",
        )
    ]
    step(None, "pairs")
    if 1 < len(samples) <= MAX_PAIRS:
        figure = plot_pair(samples, prior_samples, marks=marks)
        paths.append(save_figure(figure, out / "pairs.png"))
    step(None, "predictions")
    options = posterior.bound.options
    shown = rollouts[[0]]
    num = affordable_draws(
        NUM_PREDICTIVE, shown.readings[0].size, budget=DRAW_BUDGET.most_bytes // 4
    )
    few = {name: value[:num] for name, value in draws.items()}
    replayed = replay(model, shown, few, options)
    single = replay(model, shown, {n: v[None] for n, v in most_likely.items()}, options)
    names = replayed.channel_names
    figure = plot_bands(
        shown.times_of_series[0],
        shown.series(names)[0].numpy(),
        replayed.series()[0].double().cpu().numpy(),
        channel_names=names,
        units=replayed.units,
        lines={
            "most likely": single.series()[0][0].double().cpu().numpy(),
            **nominal_line(model, shown, options),
        },
        resets=replayed.inputs.start.double().numpy() * shown.time_step,
    )
    paths.append(save_figure(figure, out / "bands.png"))
    step(1.0, "")
    return paths


def _values(parameters: dict[str, Tensor]) -> dict[str, float]:
    columns = scalar_columns({name: value[None] for name, value in parameters.items()})
    return {name: float(value[0]) for name, value in columns.items()}
