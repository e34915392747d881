"""Table 2 of Muratore et al. (2021): the real Furuta pendulum, replayed in simulation.

Every method gets the same recordings: the first rollouts to fit, the last ones to be judged on,
with the state re-synchronised to the recording every 200 steps of 2 ms as in the paper's code.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.inference.base import Backend
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.evaluation import nominal_parameters, score
from npdr_ppl.workflows.fit import fit
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.run_folder import write_json

__all__ = ["PAPER", "reproduce_table2"]

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "nominal": {"rmse": {"mean": 0.384, "std": 0.003}, "dtw": {"mean": 1430.0, "std": 30.0}},
    "snpe-c": {"rmse": {"mean": 0.263, "std": 0.004}, "dtw": {"mean": 1070.0, "std": 30.0}},
    "bayessim": {"rmse": {"mean": 0.295, "std": 0.002}, "dtw": {"mean": 1240.0, "std": 60.0}},
    "bayesian-linear-regression": {
        "rmse": {"mean": 0.446, "std": 0.007},
        "dtw": {"mean": 2240.0, "std": 40.0},
    },
}
"""The paper's figures; its NPDR is SNPE-C."""

SEGMENT_LENGTH = 200
EMBEDDING = "all/50"
"""Readings four times per segment: with re-synchronised segments they carry what the parameters
do, where the paper's statistic sums over them."""
ROUNDS = 5
NUM_SIMULATIONS = 3_000


def reproduce_table2(
    rollouts: Rollouts,
    out: Path,
    *,
    holdout: tuple[int, ...] = (3, 4),
    backend: str | Backend = "snpe-c",
    rounds: int | None = None,
    num_simulations: int | None = None,
    initial_state: Literal["estimated", "recorded"] = "recorded",
    seed: int = 0,
    progress: bool | None = None,
) -> tuple[Posterior, dict[str, Any]]:
    """Computes the columns of Table 2 and writes ``table2.json``.

    Args:
        rollouts: The paper's recordings, 500 Hz.
        out: Folder for results.
        holdout: Rollouts to be judged on; the others are fitted.
        backend: The backend of NPDR's column.
        rounds: Rounds of inference; :data:`ROUNDS` if not given.
        num_simulations: Simulations of each; :data:`NUM_SIMULATIONS` if not given.
        initial_state: ``"recorded"``, the paper's way, or ``"estimated"``.
        seed: Seed of everything random.
        progress: Whether to show progress; ``None`` shows it on a terminal.

    Returns:
        The posterior and the content of ``table2.json``.
    """
    rollouts.check(Furuta.sensors, Furuta.actions)
    train = rollouts[[i for i in range(len(rollouts)) if i not in holdout]]
    test = rollouts[list(holdout)]
    options = BindingOptions(EMBEDDING, SEGMENT_LENGTH, initial_state, "float32")
    posterior, fitted = fit(
        furuta,
        train,
        test,
        out=out,
        backend=backend,
        rounds=rounds or ROUNDS,
        num_simulations=num_simulations or NUM_SIMULATIONS,
        seed=seed,
        options=options,
        progress=progress,
    )
    exact = BindingOptions(EMBEDDING, SEGMENT_LENGTH, initial_state, "float64")
    nominal = nominal_parameters(furuta, train.inputs(SEGMENT_LENGTH))
    most_likely = {k: torch.tensor(v) for k, v in fitted["most_likely"].items()}
    result = {
        "rows": {
            # Nothing is fitted in the nominal column, so it is judged on all rollouts, as in the
            # paper; the other columns on the held-out ones alone.
            "nominal": _row(score(furuta, rollouts, nominal, exact)),
            posterior.backend.name: _row(score(furuta, test, most_likely, exact)),
        },
        "paper": PAPER,
        "held_out": list(holdout),
        "initial_state": initial_state,
        "fit": fitted,
    }
    write_json(out / "table2.json", result)
    return posterior, result


def _row(scores: Mapping[str, Tensor]) -> dict[str, metrics.Summary]:
    return {name: metrics.summarise(value) for name, value in scores.items()}
