"""`npdr compare` as a function: backends on the same model, data, budget and seed."""

import dataclasses
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torch import Tensor

from npdr_ppl.errors import BackendError, DataError, NpdrError
from npdr_ppl.language.model import Model
from npdr_ppl.memory import sampled_memory
from npdr_ppl.posterior.comparison.compared_backends import (
    Backends,
    Candidate,
    candidates,
    folder_name,
)
from npdr_ppl.posterior.comparison.comparison_result import Comparison
from npdr_ppl.posterior.comparison.comparison_rows import Figures, Row
from npdr_ppl.posterior.comparison.error_model import ErrorModel, find_error_model
from npdr_ppl.posterior.comparison.predictive_scores import predictive_scores
from npdr_ppl.posterior.comparison.stacking import StackedPosterior, Stacking, mixture_elpd, stack
from npdr_ppl.posterior.diagnostics import diagnose
from npdr_ppl.posterior.fit import describe
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.posterior import Posterior, PosteriorBase
from npdr_ppl.posterior.prepare import held_out
from npdr_ppl.preparation.binding import BoundModel, Data, bind
from npdr_ppl.preparation.data_options import PLAIN_FEATURES, DataOptions, checked_options
from npdr_ppl.preparation.evaluation import score
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import claimed, holds_this_run, read_json, write_json
from npdr_ppl.run_records import MemoryRecord

__all__ = ["compare"]


def compare(
    model: Model,
    train: Data,
    test: Data | None = None,
    *,
    backends: Backends,
    rounds: int = 2,
    num_simulations: int = 2_000,
    seed: int = 0,
    options: DataOptions | None = None,
    device: str = "cpu",
    out: Path | None = None,
    progress: bool | Reporter | None = None,
) -> Comparison:
    """Compares inference backends on one model and recording.

    All get the same budget of ``rounds * num_simulations`` simulations, the same noise of readings
    and the same seed; a backend that is not sequential spends its budget in one round. A backend
    that fails becomes a row that says why.

    Every posterior is evaluated on held-out segments: log predictive density (elpd) under an error
    model that is common to all, see :mod:`npdr_ppl.posterior.comparison.error_model`; CRPS and
    coverage of its predictive distribution; RMSE and DTW of its most likely draw. The ranking is
    by elpd. Stacking weights maximise the elpd of the posteriors' mixture on the same segments, so
    the figures of the mixture are optimistic. Without held-out data the fitted segments are used,
    with elpd by leave-one-out (PSIS-LOO), which presumes exact posteriors.

    Args:
        model: A Pyro model with black-box sites.
        train: Rollouts to fit, or other data that :func:`npdr_ppl.infer` takes.
        test: Held-out data of the same kind; ``None`` evaluates on the fitted data.
        backends: Backends by label, or in sequence by name or text; see
            :mod:`npdr_ppl.posterior.comparison.compared_backends`.
        rounds: Rounds of simulating and training.
        num_simulations: Simulations of each round.
        seed: Seed of everything random.
        options: How the data are prepared.
        device: Where the backends train.
        out: Folder for ``comparison.json`` and, for every backend, ``posterior.nc`` and the run,
            from which an interrupted comparison continues; nothing is written if ``None``.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Raises:
        BackendError: A backend or an option does not exist, or every backend failed.
        DataError: The data do not fit the model, held-out data have other parameters, or the
            folder holds another comparison.

    Example:
        >>> import pyro, pyro.distributions as dist, torch
        >>> import npdr_ppl as npdr
        >>> def model():
        ...     mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
        ...     npdr.simulate("x", lambda mean: mean, {"mean": mean}, noise=0.5)
        >>> comparison = npdr.compare(
        ...     model, torch.tensor(1.0), torch.tensor(0.8), rounds=1, num_simulations=200,
        ...     backends=["snpe-c(epochs=3)", "maf = snpe-c(flow=maf, epochs=3)"], progress=False,
        ... )
        >>> sorted(comparison.ranking)
        ['maf', 'snpe-c(epochs=3)']
        >>> comparison.ensemble.sample(10)["mean"].shape
        torch.Size([10])
    """
    options = checked_options(options)
    named = candidates(backends)
    judged_by = train if test is None else test
    settings = {
        "rounds": rounds,
        "num_simulations": num_simulations,
        "seed": seed,
        "noise": options.noise,
        "binding": _described(options),
        "evaluated_on": "fitted" if test is None else "held-out",
        "elpd": "PSIS-LOO" if test is None else "held-out segments",
    }
    with reporter(progress) as report, ExitStack() as stack:
        error_model = find_error_model(
            model,
            train,
            options,
            seed=seed,
            progress=report.stage("find the closest parameters"),
        )
        prepared = error_model.prepared
        if prepared is not None:
            train = judged_by = prepared.rollouts
            if isinstance(test, Rollouts):
                judged_by = prepared.repair.applied_to(test)
        # Posteriors are judged without features.
        exact = dataclasses.replace(options, precision="float64", embedding=PLAIN_FEATURES)
        likelihood = None
        if prepared is not None and isinstance(judged_by, Rollouts):
            likelihood = prepared.likelihood if test is None else held_out(prepared, judged_by)
        judge = _Judge(
            error_model,
            judged_by,
            bind(
                error_model.judged,
                judged_by,
                exact,
                device,
                starts=None if likelihood is None else likelihood.segments.starts,
                likelihood=likelihood,
            ),
            exact,
            is_held_out=test is not None,
            seed=seed,
        )
        stack.enter_context(claimed(out))
        if out is not None:
            _begin(out, settings)
        rows: dict[str, Row] = {}
        posteriors: dict[str, Posterior] = {}
        for label, candidate in named.items():
            run = _Run(
                candidate,
                rounds if candidate.is_sequential else 1,
                num_simulations if candidate.is_sequential else rounds * num_simulations,
                options,
                device,
                None if out is None else out / folder_name(label),
                report.under(label),
            )
            try:
                posterior, peak = run.posterior(error_model, train, seed)
                rows[label] = run.row(posterior, peak, judge)
                posteriors[label] = posterior
            except NpdrError as error:
                rows[label] = Row(candidate.backend.name, error=str(error))
    if not posteriors:
        reasons = "; ".join(f"{label}: {row.error}" for label, row in rows.items())
        raise BackendError(f"Every backend failed. {reasons}")
    stacking, mixture = _mix(rows, posteriors, judge)
    comparison = Comparison(rows, posteriors, stacking, mixture, error_model, settings)
    if out is not None:
        write_json(out / "comparison.json", comparison.to_dict())
    return comparison


@dataclasses.dataclass(frozen=True)
class _Judge:
    """Evaluates posteriors on a recording, in float64, also those that were fitted in float32."""

    error_model: ErrorModel
    data: Data
    bound: BoundModel
    options: DataOptions
    is_held_out: bool
    seed: int

    def figures(self, posterior: PosteriorBase, most_likely: dict[str, Tensor]) -> Figures:
        if posterior.prior.num_parameters != self.bound.prior.num_parameters:
            raise DataError(
                f"The model has {posterior.prior.num_parameters} parameters on the fitted data, "
                f"but {self.bound.prior.num_parameters} on those it is judged by."
            )
        scores = {}
        if isinstance(self.data, Rollouts):
            scores = score(self.error_model.judged, self.data, most_likely, self.options)
        predictive = predictive_scores(
            posterior,
            self.bound,
            self.error_model.share,
            is_held_out=self.is_held_out,
            seed=self.seed,
        )
        return Figures(
            tuple(scores["rmse"].tolist()) if scores else (),
            tuple(scores["dtw"].tolist()) if scores else (),
            {name: value.tolist() for name, value in most_likely.items()},
            predictive.elpd,
            predictive.elpd_draws,
            predictive.crps,
            predictive.coverage,
            predictive.num_failed,
        )


@dataclasses.dataclass(frozen=True)
class _Run:
    """One backend's part of a comparison."""

    candidate: Candidate
    rounds: int
    num_simulations: int
    options: DataOptions
    device: str
    folder: Path | None
    report: Reporter

    def posterior(
        self, error_model: ErrorModel, data: Data, seed: int
    ) -> tuple[Posterior, float | None]:
        """Infers, or continues; returns the posterior and the peak of memory in MiB."""
        own, prepared = self.candidate.embedding, error_model.prepared
        if own is not None and prepared is not None:
            prepared = prepared.with_features(own)
        with sampled_memory() as memory:
            posterior = infer(
                error_model.fitted,
                data,
                backend=self.candidate.backend,
                rounds=self.rounds,
                num_simulations=self.num_simulations,
                seed=seed,
                options=self.options
                if own is None
                else dataclasses.replace(self.options, embedding=own),
                preparation=prepared,
                start=None if prepared is None else prepared.neighbourhood(),
                corrects=False,
                device=self.device,
                checkpoint=None if self.folder is None else self.folder / "run",
                progress=self.report,
            )
        return posterior, self._greatest(memory.peak)

    def _greatest(self, peak: float | None) -> float | None:
        """Returns the greatest peak of this and of earlier, interrupted parts of the run."""
        if self.folder is None or peak is None:
            return peak
        file = self.folder / "memory.json"
        if file.exists():
            peak = max(peak, read_json(file, MemoryRecord)["peak_memory_mib"])
        write_json(file, {"peak_memory_mib": peak})
        return peak

    def row(self, posterior: Posterior, peak: float | None, judge: _Judge) -> Row:
        """Draws from the posterior, evaluates it, and saves it."""
        step = self.report.stage("judge")
        started = time.perf_counter()
        most_likely = posterior.most_likely(seed=judge.seed)
        sampled = time.perf_counter() - started
        data = posterior.to_arviz(seed=judge.seed)
        if self.folder is not None:
            from npdr_ppl.arviz_module import to_netcdf

            to_netcdf(data, self.folder / "posterior.nc")
        step(None, "sampled")
        figures = judge.figures(posterior, most_likely)
        step(1.0, "")
        infos = posterior.provenance.rounds
        return Row(
            posterior.backend.name,
            figures=figures,
            diagnosis=diagnose(data),
            parameters=describe(data)["parameters"],
            rounds=len(infos),
            num_simulations=sum(info.num_simulations for info in infos),
            num_failed=sum(info.num_failed for info in infos),
            faults=posterior.provenance.faults,
            seconds={**posterior.provenance.seconds, "sample": sampled},
            peak_memory=peak,
        )


def _mix(
    rows: Mapping[str, Row], posteriors: Mapping[str, Posterior], judge: _Judge
) -> tuple[Stacking | None, Figures | None]:
    """Returns stacking weights and the mixture's figures, where there is a finite elpd."""
    pointwise = {
        label: row.figures.elpd
        for label, row in rows.items()
        if row.figures is not None and row.figures.elpd is not None
    }
    try:
        stacking = stack(pointwise)
    except DataError:
        return None, None
    used = {label: weight for label, weight in stacking.weights.items() if weight > 0}
    members = {label: posteriors[label] for label in used}
    mixture = StackedPosterior(members, used)
    figures = judge.figures(mixture, mixture.most_likely(seed=judge.seed))
    # Exactly that of the mixture, instead of one more Monte-Carlo estimate.
    return stacking, dataclasses.replace(figures, elpd=mixture_elpd(pointwise, used))


def _described(options: DataOptions) -> dict[str, Any]:
    values = dataclasses.asdict(options)
    embedding = options.embedding
    return values | {"embedding": embedding if isinstance(embedding, str) else repr(embedding)}


def _begin(out: Path, settings: Mapping[str, Any]) -> None:
    """Notes the settings, or checks that the folder holds this very comparison already.

    Raises:
        DataError: The folder holds a comparison with other settings.
    """
    file = out / "settings.json"
    if not holds_this_run(file, settings):
        write_json(file, settings)
