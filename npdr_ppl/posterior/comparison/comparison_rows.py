"""Results of each backend that was compared."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.posterior.diagnostics import Diagnosis

__all__ = ["Figures", "Row"]


@dataclass(frozen=True)
class Figures:
    """Scores of a posterior on the recording on which it is evaluated.

    Attributes:
        rmse: RMSE of the most likely draw per rollout, dimensionless; empty for observations that
            are not rollouts.
        dtw: DTW of the most likely draw per rollout, dimensionless; empty for observations that
            are not rollouts.
        most_likely: The most likely draw, by latent site.
        elpd: Log predictive density of every segment, ``(segments,)``; ``None`` if there is no
            likelihood.
        elpd_draws: Effective number of draws in a segment's density, for the segment where it is
            smallest.
        crps: Mean CRPS of a measurement in units of its channel's range.
        coverage: Share of measurements inside the central predictive interval, by its probability.
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
    """Results of one backend.

    Attributes:
        backend: Its name.
        error: Why it failed, one sentence; ``None`` if it succeeded. The attributes below are set
            only if it succeeded.
        figures: Scores of its posterior on the recording on which it is evaluated.
        diagnosis: Diagnosis of its posterior.
        parameters: Mean, standard deviation and 94 % interval of every parameter.
        rounds: Number of rounds.
        num_simulations: Number of simulations in all rounds.
        num_failed: Number of these simulations that failed.
        faults: Number of faults at workers, by kind; empty if no workers were used.
        seconds: Time to ``simulate``, ``train`` and ``sample`` (10 000 draws with densities).
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
        """Sort key of the ranking, smaller is better: −elpd, then CRPS; infinite if unknown."""
        if self.figures is None:
            return (math.inf, math.inf)
        elpd = -math.inf if self.figures.elpd is None else float(np.sum(self.figures.elpd))
        crps = self.figures.crps
        return (
            -elpd if math.isfinite(elpd) else math.inf,
            crps if math.isfinite(crps) else math.inf,
        )
