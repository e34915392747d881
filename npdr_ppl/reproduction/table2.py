"""Table 2 of Muratore et al. (2021): the real Furuta pendulum, replayed in simulation.

Every method gets the same recordings: the first rollouts for the fit, the last ones for the
evaluation. The state is re-synchronised to the recording every 200 steps of 2 ms, as in the
paper's code.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.loop.control_task import control_task
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.posterior.comparison.compare import compare
from npdr_ppl.posterior.comparison.compared_backends import requested
from npdr_ppl.posterior.comparison.comparison_result import Comparison
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import nominal_parameters, score
from npdr_ppl.progress import Reporter
from npdr_ppl.reproduction.rig_study import study, summarise
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import InitialState
from npdr_ppl.run_files import write_json

__all__ = ["COLUMNS", "PAPER", "add_returns", "reproduce_table2"]

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "nominal": {
        "rmse": {"mean": 0.384, "std": 0.003},
        "dtw": {"mean": 1430.0, "std": 30.0},
        "return_sim": {"mean": 2130.0, "std": 50.0},
        "return_rig": {"mean": 110.0, "std": 33.0},
    },
    "snpe-c": {
        "rmse": {"mean": 0.263, "std": 0.004},
        "dtw": {"mean": 1070.0, "std": 30.0},
        "return_sim": {"mean": 934.0, "std": 935.0},
        "return_rig": {"mean": 2020.0, "std": 180.0},
    },
    "bayessim": {
        "rmse": {"mean": 0.295, "std": 0.002},
        "dtw": {"mean": 1240.0, "std": 60.0},
        "return_sim": {"mean": 131.0, "std": 357.0},
        "return_rig": {"mean": 1110.0, "std": 760.0},
    },
    "bayesian-linear-regression": {
        "rmse": {"mean": 0.446, "std": 0.007},
        "dtw": {"mean": 2240.0, "std": 40.0},
        "return_sim": {"mean": 2050.0, "std": 300.0},
        "return_rig": {"mean": 328.0, "std": 144.0},
    },
}
"""The paper's numbers; its NPDR is SNPE-C, and its rig is real."""

RETURN_METHODS: Mapping[str, str] = {
    "nominal": "nominal",
    "snpe-c": "npdr",
    "bayessim": "bayessim",
    "bayesian-linear-regression": "bayesian-linear-regression",
    "default gains": "default gains",
    "prior": "prior",
    "snpe-c with effects": "npdr with effects",
}
"""Rows of the returns, and their names in :mod:`npdr_ppl.reproduction.rig_study`."""

RIG = "furuta-hard"
"""The rig in MuJoCo that replaces the paper's rig, which is not available."""

SEGMENT_LENGTH = 200
EMBEDDING = "all/50"
"""Measurements at four times per segment. In re-synchronised segments they show the influence of
the parameters, while the paper's statistic sums over the segments."""
ROUNDS = 5
NUM_SIMULATIONS = 3_000

COLUMNS: Mapping[str, str] = {
    "snpe-c": f"snpe-c(embedding={EMBEDDING})",
    # The statistic that has the method's name.
    "bayessim": "bayessim(embedding=bayessim)",
    "bayesian-linear-regression": "bayesian-linear-regression",
}
"""The paper's methods by label, in the syntax of
:mod:`npdr_ppl.posterior.comparison.compared_backends`. All get the same number of simulations;
methods that are not sequential, or use no simulations, run in one round."""


def reproduce_table2(
    rollouts: Rollouts,
    out: Path,
    *,
    holdout: tuple[int, ...] = (3, 4),
    backends: Sequence[str] | None = None,
    rounds: int | None = None,
    num_simulations: int | None = None,
    initial_state: InitialState = "recorded",
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> tuple[Comparison, dict[str, Any]]:
    """Computes the columns of Table 2 and writes ``table2.json``.

    Args:
        rollouts: The paper's recordings, 500 Hz.
        out: Folder for results.
        holdout: Rollouts for the evaluation; the others are fitted.
        backends: Labels of :data:`COLUMNS`, or other backends; ``None`` for all columns with an
            available backend; the others are recorded as skipped.
        rounds: Rounds of inference; :data:`ROUNDS` if not given.
        num_simulations: Simulations per round; :data:`NUM_SIMULATIONS` if not given.
        initial_state: ``"recorded"``, as in the paper, or ``"estimated"``.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The comparison and the content of ``table2.json``.
    """
    rollouts.check(Furuta.sensors, Furuta.actions)
    train = rollouts[[i for i in range(len(rollouts)) if i not in holdout]]
    test = rollouts[list(holdout)]
    chosen, skipped = requested(backends, COLUMNS)
    comparison = compare(
        furuta,
        train,
        test,
        backends=chosen,
        rounds=rounds or ROUNDS,
        num_simulations=num_simulations or NUM_SIMULATIONS,
        seed=seed,
        options=DataOptions(EMBEDDING, SEGMENT_LENGTH, initial_state, "float32"),
        out=out,
        progress=progress,
    )
    exact = DataOptions(EMBEDDING, SEGMENT_LENGTH, initial_state, "float64")
    nominal = nominal_parameters(furuta, train.inputs(SEGMENT_LENGTH))
    # Nothing is fitted in the nominal column, so it is evaluated on all rollouts, as in the paper.
    # The other columns are evaluated on the held-out rollouts only.
    rows = {"nominal": _row(score(furuta, rollouts, nominal, exact))}
    failed: dict[str, str] = {}
    for label, row in comparison.rows.items():
        if row.figures is None:
            failed[label] = row.error or ""
        else:
            rmse, dtw = torch.tensor(row.figures.rmse), torch.tensor(row.figures.dtw)
            rows[label] = _row({"rmse": rmse, "dtw": dtw})
    result = {
        "rows": rows,
        "paper": PAPER,
        "skipped": skipped,
        "failed": failed,
        "held_out": list(holdout),
        "initial_state": initial_state,
        "comparison": comparison.to_dict(),
    }
    write_json(out / "table2.json", result)
    return comparison, result


def add_returns(
    result: dict[str, Any],
    out: Path,
    *,
    num_seeds: int,
    options: DataOptions | None = None,
    loop: LoopOptions | None = None,
    progress: bool | Reporter | None = None,
) -> dict[str, Any]:
    """Trains policies by every method and adds their returns to the rows of ``table2.json``.

    The paper's rig is not available, so the policies run on a hidden rig in MuJoCo.

    Args:
        result: The content of ``table2.json``.
        out: Folder for results and runs; existing results are reused.
        num_seeds: Training runs of each method.
        options: How rollouts are prepared; the loop's default if ``None``.
        loop: Options of the loop.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The changed content of ``table2.json``.
    """
    found = study(
        list(RETURN_METHODS.values()),
        [RIG],
        range(num_seeds),
        # Checks are disabled, so that every method trains equally often.
        loop or LoopOptions(least_success=0.0),
        out / "returns",
        options=options,
        progress=progress,
    )
    success = control_task("furuta-swing-up").success
    assert success is not None
    rows = {label: dict(row) for label, row in result["rows"].items()}
    for label, method in RETURN_METHODS.items():
        figures = summarise(found[method], success)
        row = {name: figures[name] for name in ("return_sim", "return_rig")}
        rows[label] = rows.get(label, {}) | row
    changed = result | {"rows": rows, "rig": RIG, "training_seeds": num_seeds}
    write_json(out / "table2.json", changed)
    return changed


def _row(scores: Mapping[str, Tensor]) -> dict[str, metrics.Summary]:
    return {name: metrics.summarise(value) for name, value in scores.items()}
