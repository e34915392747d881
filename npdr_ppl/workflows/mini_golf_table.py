"""Table 1 of Muratore et al. (2021): real strikes of a golf ball, replayed in simulation.

Every method is fitted to each strike and judged on the same, as in the paper; beside it, it is
fitted to all strikes but one and judged on that one. The mean of the other strikes, taken as a
prediction of the one left out, says how well the rig repeats itself: no simulator that is told
the same inputs predicts a strike much better, however well it fits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.errors import BackendError, DataError, NpdrError
from npdr_ppl.models.mini_golf import MiniGolf, mini_golf
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.candidates import Candidate, available, candidates, folder_name
from npdr_ppl.workflows.evaluation import nominal_parameters, score
from npdr_ppl.workflows.infer import infer
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.run_folder import write_json

__all__ = ["COLUMNS", "PAPER", "repeatability", "reproduce_mini_golf"]

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "nominal": {"rmse": {"mean": 8.60e-2, "std": 0.0}, "dtw": {"mean": 151.0, "std": 0.0}},
    "snpe-c": {"rmse": {"mean": 7.19e-3, "std": 0.65e-3}, "dtw": {"mean": 33.0, "std": 1.6}},
    "bayessim": {"rmse": {"mean": 2.19e-2, "std": 0.51e-2}, "dtw": {"mean": 92.1, "std": 6.4}},
}
"""The paper's figures; its NPDR is SNPE-C."""

BALL = ("ball_x", "ball_y")
EMBEDDING = "linear[ball_x,ball_y]/2"
ROUNDS = 6
NUM_SIMULATIONS = 1_500

COLUMNS: Mapping[str, str] = {
    "snpe-c": f"snpe-c(embedding={EMBEDDING})",
    "bayessim": "bayessim(embedding=bayessim)",
}
"""The paper's methods by label, in the words of :mod:`npdr_ppl.workflows.candidates`. All get the
same number of simulations; BayesSim, which is not sequential, in one round."""

OPTIONS = BindingOptions(EMBEDDING, None, "recorded")


@dataclass(frozen=True)
class _Budget:
    """How much a fit may cost, and where it is kept.

    Attributes:
        rounds: Rounds of a sequential method.
        num_simulations: Simulations of each round; others get all at once.
        seed: Seed of everything random.
        out: Folder for runs.
        progress: Whether to show progress.
    """

    rounds: int
    num_simulations: int
    seed: int
    out: Path
    progress: bool | None

    def fit(self, label: str, candidate: Candidate, rollouts: Rollouts, name: str) -> Posterior:
        """Fits the ten parameters to strikes, or continues a fit that was interrupted."""
        rounds = self.rounds if candidate.is_sequential else 1
        return infer(
            mini_golf,
            rollouts,
            backend=candidate.backend,
            rounds=rounds,
            num_simulations=self.rounds * self.num_simulations // rounds,
            seed=self.seed,
            embedding=candidate.embedding or EMBEDDING,
            initial_state="recorded",
            checkpoint=self.out / folder_name(label) / name,
            progress=self.progress,
        )


def reproduce_mini_golf(
    rollouts: Rollouts,
    out: Path,
    *,
    backends: Sequence[str] | None = None,
    rounds: int | None = None,
    num_simulations: int | None = None,
    leave_one_out: bool = True,
    seed: int = 0,
    progress: bool | None = None,
) -> tuple[dict[str, list[Posterior]], dict[str, Any]]:
    """Computes Table 1 and writes ``mini-golf.json``.

    Args:
        rollouts: The paper's recordings, 100 Hz.
        out: Folder for results; what it holds of an interrupted run is not simulated again.
        backends: Labels of :data:`COLUMNS`, or other backends; ``None`` for all columns whose
            backend there is, the others being noted as skipped.
        rounds: Rounds of inference; :data:`ROUNDS` if not given.
        num_simulations: Simulations of each; :data:`NUM_SIMULATIONS` if not given.
        leave_one_out: Whether to fit all strikes but one, too, which takes three times as long.
        seed: Seed of everything random.
        progress: Whether to show progress; ``None`` shows it on a terminal.

    Returns:
        The posteriors of the single strikes by method, and the content of ``mini-golf.json``.

    Raises:
        BackendError: Every backend failed.
        DataError: The recordings do not fit the simulator.
    """
    rollouts.check(MiniGolf.sensors, MiniGolf.actions, allow_extra=True)
    if len(rollouts) < 2:
        raise DataError("Table 1 needs two strikes at least, to leave one out; got one.")
    skipped: dict[str, str] = {}
    if backends is None:
        chosen, skipped = available(COLUMNS)
    else:
        texts = [f"{text} = {COLUMNS[text]}" if text in COLUMNS else text for text in backends]
        chosen = candidates(texts)
    out.mkdir(parents=True, exist_ok=True)
    budget = _Budget(
        rounds or ROUNDS, num_simulations or NUM_SIMULATIONS, seed, out / "runs", progress
    )
    nominal = nominal_parameters(mini_golf, rollouts.inputs(initial_state="recorded"))
    rows = {
        "nominal": _row(score(mini_golf, rollouts, nominal, OPTIONS)),
        "mean of the other strikes": _row({}, repeatability(rollouts)),
    }
    posteriors: dict[str, list[Posterior]] = {}
    strikes: dict[str, list[dict[str, float]]] = {}
    failed: dict[str, str] = {}
    for label, candidate in chosen.items():
        try:
            fits = [
                budget.fit(label, candidate, rollouts[[i]], f"strike-{i}")
                for i in range(len(rollouts))
            ]
            likely = [posterior.most_likely(seed=seed) for posterior in fits]
            within = _scores(likely, [rollouts[[i]] for i in range(len(rollouts))])
            held_out = {}
            if leave_one_out:
                held_out = _left_out(label, candidate, rollouts, budget)
        except NpdrError as error:
            failed[label] = str(error)
            continue
        posteriors[label] = fits
        rows[label] = _row(within, held_out)
        strikes[label] = [{n: float(v) for n, v in values.items()} for values in likely]
    if not posteriors:
        raise BackendError(f"Every backend failed. {'; '.join(failed.values())}")
    result = {
        "rows": rows,
        "paper": PAPER,
        "skipped": skipped,
        "failed": failed,
        "most_likely": strikes,
        "rounds": budget.rounds,
        "num_simulations": budget.num_simulations,
        "seed": seed,
    }
    write_json(out / "mini-golf.json", result)
    return posteriors, result


def repeatability(rollouts: Rollouts) -> dict[str, Tensor]:
    """Scores the mean of the other strikes as a prediction of each, ``(R,)`` per metric.

    The joints are those of the strike itself, as they are in a simulation that replays them.
    """
    series = rollouts.series()
    columns = [rollouts.channel_names.index(name) for name in BALL]
    predicted = []
    for i, own in enumerate(series):
        others = torch.stack([s for j, s in enumerate(series) if j != i]).mean(0)
        guess = own.clone()
        guess[:, columns] = others[:, columns]
        predicted.append(guess)
    return {"rmse": metrics.rmse(predicted, series), "dtw": metrics.dtw(predicted, series)}


def _left_out(
    label: str, candidate: Candidate, rollouts: Rollouts, budget: _Budget
) -> dict[str, Tensor]:
    """Fits all strikes but one and scores that one, for every one."""
    indices = range(len(rollouts))
    likely = [
        budget.fit(
            label, candidate, rollouts[[j for j in indices if j != i]], f"without-{i}"
        ).most_likely(seed=budget.seed)
        for i in indices
    ]
    return _scores(likely, [rollouts[[i]] for i in indices])


def _scores(
    parameters: Sequence[Mapping[str, Tensor]], strikes: Sequence[Rollouts]
) -> dict[str, Tensor]:
    """Scores one parameter set on each strike, ``(R,)`` per metric."""
    found = [
        score(mini_golf, strike, values, OPTIONS)
        for values, strike in zip(parameters, strikes, strict=True)
    ]
    return {name: torch.cat([scores[name] for scores in found]) for name in found[0]}


def _row(
    within: Mapping[str, Tensor], left_out: Mapping[str, Tensor] | None = None
) -> dict[str, metrics.Summary]:
    """Returns the summary of in-sample figures and, under names of their own, of held-out ones."""
    named = dict(within) | {f"{name}_left_out": v for name, v in (left_out or {}).items()}
    return {name: metrics.summarise(value) for name, value in named.items()}
