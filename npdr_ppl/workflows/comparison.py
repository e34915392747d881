"""The result of a comparison: a row for every backend, their ranking, and their mixture."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import BackendError
from npdr_ppl.workflows.diagnostics import Diagnosis
from npdr_ppl.workflows.error_model import ErrorModel
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.stacking import StackedPosterior, Stacking

__all__ = ["Comparison", "Figures", "Row"]


@dataclass(frozen=True)
class Figures:
    """How a posterior does on the recording it is judged by.

    Attributes:
        rmse: RMSE of the most likely draw per rollout, dimensionless; empty for observations that
            are not rollouts.
        dtw: DTW of the most likely draw per rollout, likewise.
        most_likely: That draw, by latent site.
        elpd: Log predictive density of every segment, ``(segments,)``; ``None`` where there is
            no likelihood.
        elpd_draws: Effective number of draws that the least certain segment's density stands on.
        crps: Mean CRPS of a reading in units of its channel's range.
        coverage: Share of readings inside the central predictive interval, by its probability.
        num_failed: Predictive draws that could not be simulated.
    """

    rmse: tuple[float, ...]
    dtw: tuple[float, ...]
    most_likely: Mapping[str, Any]
    elpd: NDArray[np.float64] | None
    elpd_draws: float
    crps: float
    coverage: Mapping[float, float]
    num_failed: int

    def to_dict(self) -> dict[str, Any]:
        """Returns the figures by their names in ``comparison.json``."""
        has_elpd = self.elpd is not None and bool(np.isfinite(self.elpd).all())
        elpd = self.elpd if self.elpd is not None and has_elpd else np.empty(0)
        return {
            "rmse": float(np.mean(self.rmse)) if self.rmse else None,
            "dtw": float(np.mean(self.dtw)) if self.dtw else None,
            "rmse_per_rollout": self.rmse,
            "dtw_per_rollout": self.dtw,
            "elpd": float(elpd.sum()) if has_elpd else None,
            "elpd_se": float(np.sqrt(len(elpd) * elpd.var())) if has_elpd else None,
            "elpd_draws": self.elpd_draws,
            "crps": self.crps,
            "coverage": {f"{level:.0%}"[:-1]: share for level, share in self.coverage.items()},
            "failed_predictions": self.num_failed,
            "most_likely": self.most_likely,
        }


@dataclass(frozen=True)
class Row:
    """What became of one backend.

    Attributes:
        backend: Its name.
        error: Why it failed, one sentence; ``None`` if it did not, and then the rest is there.
        figures: How its posterior does on the recording it is judged by.
        diagnosis: What ArviZ says of its posterior.
        parameters: Mean, standard deviation and 94 % interval of every parameter.
        rounds: Rounds it took.
        num_simulations: Simulations in all.
        num_failed: Of these, how many failed.
        faults: Counts of what went wrong at workers, by kind; empty where none were used.
        seconds: To ``simulate``, ``train`` and ``sample`` (ten thousand draws with densities).
        peak_memory: Sampled increase of resident memory while it ran, MiB; ``None`` if unknown.
    """

    backend: str
    error: str | None = None
    figures: Figures | None = None
    diagnosis: Diagnosis | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    rounds: int = 0
    num_simulations: int = 0
    num_failed: int = 0
    faults: Mapping[str, int] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_memory: float | None = None

    @property
    def score(self) -> tuple[float, float]:
        """What is ranked by, smaller is better: minus elpd, then CRPS, infinite if not finite."""
        if self.figures is None:
            return (math.inf, math.inf)
        elpd = -math.inf if self.figures.elpd is None else float(np.sum(self.figures.elpd))
        crps = self.figures.crps
        return (
            -elpd if math.isfinite(elpd) else math.inf,
            crps if math.isfinite(crps) else math.inf,
        )


@dataclass(frozen=True)
class Comparison:
    """Backends side by side on one model, recording, budget and seed.

    Attributes:
        rows: A row for every backend by label, in the order given.
        posteriors: The posteriors by label, of the backends that did not fail.
        stacking: Stacking weights and differences; ``None`` where no backend has a finite elpd.
        mixture: Figures of the mixture by these weights, on the segments that chose them.
        error_model: The error model that all are judged by.
        settings: What was asked for.
    """

    rows: Mapping[str, Row]
    posteriors: Mapping[str, Posterior]
    stacking: Stacking | None
    mixture: Figures | None
    error_model: ErrorModel
    settings: Mapping[str, Any]

    @property
    def ranking(self) -> list[str]:
        """Labels from the best to the worst, by elpd, or CRPS where no elpd is finite.

        Backends that failed are not ranked; equal ones keep the order they were given in.
        """
        ranked = [label for label, row in self.rows.items() if row.error is None]
        return sorted(ranked, key=lambda label: self.rows[label].score)

    @property
    def ranks(self) -> dict[str, int]:
        """The place of every ranked label, counted from 1; equal ones share a place."""
        scores = [self.rows[label].score for label in self.ranking]
        return {label: 1 + scores.index(self.rows[label].score) for label in self.ranking}

    @property
    def weights(self) -> dict[str, float]:
        """Stacking weights by label; empty where no backend has a finite elpd."""
        return {} if self.stacking is None else dict(self.stacking.weights)

    @cached_property
    def ensemble(self) -> StackedPosterior:
        """The posteriors mixed by stacking weights, itself a posterior.

        Raises:
            BackendError: There are no weights.
        """
        if self.stacking is None:
            raise BackendError(
                "There are no stacking weights: no backend gives the segments a finite density."
            )
        members = {label: self.posteriors[label] for label in self.weights}
        return StackedPosterior(members, self.weights)

    def _repr_html_(self) -> str:
        from npdr_ppl.workflows.notebook import comparison_html

        return comparison_html(self)

    def plot(self, axes: Any = None) -> NDArray[Any]:
        """Draws how far each backend is behind the best, and the coverage of its predictions.

        Args:
            axes: Two axes to draw on; ``None`` makes a figure.

        Returns:
            The axes, ``(2,)``.
        """
        from npdr_ppl.workflows.notebook import plot_comparison

        return plot_comparison(self, axes)

    def to_dict(self) -> dict[str, Any]:
        """Returns the content of ``comparison.json``; what is not finite is NaN or None."""
        return {
            "backends": {label: self._row(label) for label in self.rows},
            "ranking": self.ranking,
            "weights": self.weights,
            "ensemble": None if self.mixture is None else self.mixture.to_dict(),
            "error_model": self.error_model.to_dict(),
            "settings": dict(self.settings),
        }

    def _row(self, label: str) -> dict[str, Any]:
        row = self.rows[label]
        if row.figures is None or row.diagnosis is None:
            empty = dict.fromkeys(("rmse", "dtw", "elpd", "r_hat", "seconds"))
            return {"backend": row.backend, "error": row.error, **empty}
        stacking = self.stacking
        return {
            "backend": row.backend,
            "error": None,
            "rank": self.ranks[label],
            **row.figures.to_dict(),
            "elpd_difference": None if stacking is None else stacking.difference.get(label),
            "elpd_difference_se": (
                None if stacking is None else stacking.standard_error.get(label)
            ),
            "weight": self.weights.get(label),
            "r_hat": row.diagnosis.r_hat,
            "decision": row.diagnosis.decision.value,
            "diagnosis": row.diagnosis.to_dict(),
            "parameters": row.parameters,
            "rounds": row.rounds,
            "num_simulations": row.num_simulations,
            "num_failed": row.num_failed,
            **({"faults": dict(row.faults)} if row.faults else {}),
            "seconds": dict(row.seconds),
            "peak_memory_mib": row.peak_memory,
        }
