"""What a posterior shows of itself in a notebook."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.drawing.columns import scalar_columns
from npdr_ppl.drawing.html import facts, table
from npdr_ppl.drawing.marginal import draw_marginal
from npdr_ppl.drawing.page_style import styled
from npdr_ppl.drawing.panels import panels
from npdr_ppl.posterior.density_mixture import DensityMixture
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.randomness import seeded

__all__ = ["plot_posterior", "posterior_html"]

NUM_DRAWS = 1_000
MAX_COLUMNS = 4


def posterior_html(posterior: DensityMixture) -> str:
    """Returns mean, spread and central interval of every parameter as HTML."""
    samples, prior = _samples(posterior, NUM_DRAWS, seed=0)
    units = parameter_units(posterior.prior)
    rows = []
    for name, values in samples.items():
        low, high = np.quantile(values, [0.03, 0.97])
        spread = prior[name].std()
        learnt = f"{1 - values.std() / spread:.0%}" if spread > 0 else "–"
        rows.append(
            [
                name,
                units.get(name, "–"),
                f"{values.mean():.4g}",
                f"{values.std():.2g}",
                f"{low:.4g} … {high:.4g}",
                learnt,
            ]
        )
    head = facts(
        "Posterior",
        {
            "backend": posterior.backend_name,
            "parameters": str(len(samples)),
            "components": str(len(posterior.densities)),
        },
    )
    columns = ("parameter", "unit", "mean", "sd", "central 94 %", "contraction")
    return styled(head + table(columns, rows))


def plot_posterior(
    posterior: DensityMixture, axes: Any = None, *, num_samples: int, seed: int
) -> NDArray[Any]:
    """Draws every marginal over its prior; see :meth:`PosteriorBase.plot`."""
    samples, prior = _samples(posterior, num_samples, seed=seed)
    units = parameter_units(posterior.prior)
    drawn = panels(axes, len(samples), columns=MAX_COLUMNS, size=(2.6, 1.9))
    for axis, (name, values) in zip(drawn, samples.items(), strict=True):
        draw_marginal(axis, values, prior[name])
        unit = units.get(name, "")
        axis.set_xlabel(f"{name} [{unit}]" if unit and unit != "1" else name)
    drawn[0].legend()
    return drawn


def _samples(
    posterior: DensityMixture, num_samples: int, *, seed: int
) -> tuple[dict[str, NDArray[np.float64]], dict[str, NDArray[np.float64]]]:
    """Returns draws of posterior and prior by scalar parameter."""
    prior = posterior.prior
    samples = {n: v.cpu() for n, v in posterior.sample(num_samples, seed=seed).items()}
    with seeded(seed, "figures"):
        before = {n: v.cpu() for n, v in prior.to_parameters(prior.sample(num_samples)).items()}
    return scalar_columns(samples), scalar_columns(before)
