"""Table 1 of Muratore et al. (2021): real strikes of a golf ball, replayed in simulation.

Every method is fitted to each strike and evaluated on the same strike, as in the paper, by the
most likely of its draws (see :func:`~npdr_ppl.reproduction.mini_golf_fit.most_likely_draw`). In
addition, it is fitted to all strikes except one and evaluated on that one. The mean of the other
strikes, used as a prediction of the one left out, measures the rig's repeatability: no simulator
with the same inputs predicts a strike much better.

``dtw`` is that of Table 2, which uses the whole recording. ``dtw_open`` uses the whole simulation
instead and may leave out the recording's end. It is smaller, and with it the rig's repeatability
agrees with the paper's value.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.errors import BackendError, DataError, NpdrError
from npdr_ppl.models.mini_golf import MiniGolf, mini_golf, mini_golf_two_restitutions
from npdr_ppl.posterior.comparison.compared_backends import Candidate, requested
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.preparation.evaluation import nominal_parameters
from npdr_ppl.progress import Reporter
from npdr_ppl.reproduction.mini_golf_clock import clocks_aligned
from npdr_ppl.reproduction.mini_golf_fit import (
    BALL,
    EMBEDDING,
    Budget,
    likeliest_draws,
    most_likely_draw,
    score_each,
    score_strikes,
)
from npdr_ppl.reproduction.mini_golf_posterior import figure4_facts, obstacle_angles
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import write_json

__all__ = ["COLUMNS", "PAPER", "repeatability", "reproduce_mini_golf"]

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "nominal": {"rmse": {"mean": 8.60e-2, "std": 0.0}, "dtw": {"mean": 151.0, "std": 0.0}},
    "snpe-c": {"rmse": {"mean": 7.19e-3, "std": 0.65e-3}, "dtw": {"mean": 33.0, "std": 1.6}},
    "bayessim": {"rmse": {"mean": 2.19e-2, "std": 0.51e-2}, "dtw": {"mean": 92.1, "std": 6.4}},
}
"""The paper's numbers; its NPDR is SNPE-C."""

ROUNDS = 5
NUM_SIMULATIONS = 1_500

_TRAINING = "members=1, epochs=60, batch_size=128, learning_rate=3e-3"
"""More and smaller training steps than by default: the layer has many weights, and simulations
take most of the time anyway."""

COLUMNS: Mapping[str, str] = {
    "snpe-c": f"snpe-c(embedding='{EMBEDDING}', {_TRAINING})",
    "bayessim": "bayessim(embedding='bayessim[ball_x,ball_y]')",
}
"""The paper's methods by label, in the syntax of
:mod:`npdr_ppl.posterior.comparison.compared_backends`. All get the same number of simulations;
methods that are not sequential get them in one round."""

REPEATABILITY = "mean of the other strikes"

OUTLIER = 1.5
"""A strike is left out of the joint fit if its difference from the mean of the others exceeds this
many times the median difference, because one club cannot strike with two strengths. In the
recordings this is strike 0: it is a quarter weaker, and the joints do not show why."""


def reproduce_mini_golf(
    rollouts: Rollouts,
    out: Path,
    *,
    backends: Sequence[str] | None = None,
    rounds: int | None = None,
    num_simulations: int | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> tuple[dict[str, list[Posterior]], dict[str, Any]]:
    """Computes Table 1 and writes ``mini-golf.json``.

    Args:
        rollouts: The paper's recordings, 100 Hz.
        out: Folder for results; finished parts of an interrupted run are not simulated again.
        backends: Labels of :data:`COLUMNS`, or other backends; ``None`` for all columns with an
            available backend; the others are recorded as skipped.
        rounds: Rounds of inference; :data:`ROUNDS` if not given.
        num_simulations: Simulations per round; :data:`NUM_SIMULATIONS` if not given.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The posteriors of the single strikes by method, and the content of ``mini-golf.json``.

    Raises:
        BackendError: Every backend failed.
        DataError: The recordings do not fit the simulator, or cannot be compared.
    """
    rollouts.check(MiniGolf.sensors, MiniGolf.actions, allow_extra=True)
    if len(rollouts) < 2 or len(set(rollouts.lengths)) > 1:
        raise DataError(
            "Table 1 needs at least two strikes of equal length, to leave one out; got "
            f"{rollouts.lengths} steps."
        )
    chosen, skipped = requested(backends, COLUMNS)
    out.mkdir(parents=True, exist_ok=True)
    budget = Budget(
        rounds or ROUNDS, num_simulations or NUM_SIMULATIONS, seed, out / "runs", progress
    )
    nominal = nominal_parameters(mini_golf, rollouts.inputs(initial_state="recorded"))
    rows = {
        "nominal": _row(score_strikes(mini_golf, rollouts, nominal)),
        REPEATABILITY: _row({}, repeatability(rollouts)),
    }
    posteriors: dict[str, list[Posterior]] = {}
    details: dict[str, Any] = {}
    failed: dict[str, str] = {}
    for label, candidate in chosen.items():
        try:
            posteriors[label], rows[label], details[label] = _column(
                label, candidate, rollouts, budget
            )
        except NpdrError as error:
            failed[label] = str(error)
    if not posteriors:
        raise BackendError(f"Every backend failed. {'; '.join(failed.values())}")
    result = {
        "rows": rows,
        "paper": PAPER,
        "skipped": skipped,
        "failed": failed,
        "details": details,
        "engine": MiniGolf().recorded_settings(),
        "rounds": budget.rounds,
        "num_simulations": budget.num_simulations,
        "seed": seed,
    }
    write_json(out / "mini-golf.json", result)
    return posteriors, result


def repeatability(rollouts: Rollouts) -> dict[str, Tensor]:
    """Scores the mean of the other strikes as a prediction of each, ``(R,)`` per metric.

    Joint measurements are those of the strike itself, because a simulation replays them.
    """
    series = rollouts.series()
    columns = [rollouts.channel_names.index(name) for name in BALL]
    predicted = []
    for i, own in enumerate(series):
        others = torch.stack([s for j, s in enumerate(series) if j != i]).mean(0)
        guess = own.clone()
        guess[:, columns] = others[:, columns]
        predicted.append(guess)
    return {
        "rmse": metrics.rmse(predicted, series),
        "dtw": metrics.dtw(predicted, series),
        "dtw_open": metrics.dtw(predicted, series, open_end="measured"),
    }


def _column(
    label: str, candidate: Candidate, rollouts: Rollouts, budget: Budget
) -> tuple[list[Posterior], dict[str, metrics.Summary], dict[str, Any]]:
    """Returns a method's posteriors of single strikes, its row of the table, and the details.

    The model with separate restitutions is fitted jointly to all similar strikes. One restitution
    for club and obstacles can fit either the ball's launch or its rebounds, and such a fit
    rotates the obstacles to compensate.
    """
    indices = range(len(rollouts))
    strikes = [rollouts[[i]] for i in indices]
    fits = [
        budget.fit(mini_golf, candidate, strike, label, f"strike-{i}")
        for i, strike in enumerate(strikes)
    ]
    likely = [
        most_likely_draw(posterior, mini_golf, strike, seed=budget.seed)
        for posterior, strike in zip(fits, strikes, strict=True)
    ]
    densest = [posterior.most_likely(seed=budget.seed) for posterior in fits]
    left_out = []
    for i in indices:
        others = rollouts[[j for j in indices if j != i]]
        posterior = budget.fit(mini_golf, candidate, others, label, f"without-{i}")
        left_out.append(most_likely_draw(posterior, mini_golf, others, seed=budget.seed))
    row = _row(score_each(mini_golf, likely, strikes), score_each(mini_golf, left_out, strikes))
    details = {
        "most_likely": [_floats(values) for values in likely],
        "greatest_density": _row(score_each(mini_golf, densest, strikes)),
        "figure4": [figure4_facts(posterior, seed=budget.seed) for posterior in fits],
        "angles": [obstacle_angles(values) for values in likely],
        "two_restitutions": _separate_restitutions(label, candidate, rollouts, budget),
    }
    return fits, row, details


def _separate_restitutions(
    label: str, candidate: Candidate, rollouts: Rollouts, budget: Budget
) -> dict[str, Any]:
    """Fits the model with two restitutions to the similar strikes, with aligned clocks."""
    error = repeatability(rollouts)["rmse"]
    alike = [i for i, e in enumerate(error.tolist()) if e <= OUTLIER * float(error.median())]
    strikes, delays = clocks_aligned(rollouts[alike])
    model = mini_golf_two_restitutions
    joint = budget.fit(model, candidate, strikes, label, "two-restitutions")
    likeliest = likeliest_draws(joint, model, strikes, seed=budget.seed)
    likely = {name: values[0] for name, values in likeliest.items()}
    return {
        **_row(score_strikes(model, strikes, likely)),
        "strikes": alike,
        "clock_delays": [steps * strikes.time_step for steps in delays],
        "most_likely": _floats(likely),
        "angles": obstacle_angles(likeliest),
    }


def _row(
    within: Mapping[str, Tensor], left_out: Mapping[str, Tensor] | None = None
) -> dict[str, metrics.Summary]:
    """Returns summaries of in-sample scores and, as ``*_left_out``, of held-out scores."""
    named = dict(within) | {f"{name}_left_out": v for name, v in (left_out or {}).items()}
    return {name: metrics.summarise(value) for name, value in named.items()}


def _floats(parameters: Mapping[str, Tensor]) -> dict[str, float]:
    return {name: float(value) for name, value in parameters.items()}
