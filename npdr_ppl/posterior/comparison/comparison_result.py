"""The result of a comparison: a row for every backend, their ranking, and their mixture."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from numpy.typing import NDArray

from npdr_ppl.errors import BackendError
from npdr_ppl.posterior.comparison.comparison_rows import Figures, Row
from npdr_ppl.posterior.comparison.error_model import ErrorModel
from npdr_ppl.posterior.comparison.stacking import StackedPosterior, Stacking
from npdr_ppl.posterior.posterior import Posterior

__all__ = ["Comparison"]


@dataclass(frozen=True)
class Comparison:
    """Backends side by side on one model, recording, budget and seed.

    Attributes:
        rows: A row for every backend by label, in the order given.
        posteriors: The posteriors by label, of the backends that did not fail.
        stacking: Stacking weights and differences; ``None`` where no backend has a finite elpd.
        mixture: Scores of the mixture with these weights, on the segments to which the weights
            were fitted.
        error_model: The error model with which all backends are evaluated.
        settings: The settings of the comparison.
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

        Backends that failed are not ranked. Backends with equal scores keep the order in which
        they were given.
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
        from npdr_ppl.posterior.comparison.comparison_view import comparison_html

        return comparison_html(self.rows, self.ranking, self.weights)

    def plot(self, axes: Any = None) -> NDArray[Any]:
        """Draws how far each backend is behind the best, and the coverage of its predictions.

        Args:
            axes: Two axes to draw on; ``None`` makes a figure.

        Returns:
            The axes, ``(2,)``.
        """
        from npdr_ppl.posterior.comparison.comparison_view import plot_comparison

        return plot_comparison(self.rows, self.ranking, self.stacking, axes)

    def to_dict(self) -> dict[str, Any]:
        """Returns the content of ``comparison.json``; what is not finite is NaN or None."""
        prepared = self.error_model.prepared
        return {
            "backends": {label: self._row(label) for label in self.rows},
            "ranking": self.ranking,
            "weights": self.weights,
            "ensemble": None if self.mixture is None else self.mixture.to_dict(),
            "preparation": None if prepared is None else prepared.summary.to_dict(),
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
