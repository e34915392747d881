"""`npdr fit` as a function: infer, evaluate, diagnose, draw, and write it all down."""

import shutil
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from npdr_ppl.discovery.kept_fits import keep_fits
from npdr_ppl.engines.workers import collect_faults
from npdr_ppl.errors import NpdrError
from npdr_ppl.inference.base import Backend
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.language.handlers import num_finer_steps
from npdr_ppl.language.model import Model
from npdr_ppl.model_code import code_checksum
from npdr_ppl.model_identity import engine_settings
from npdr_ppl.posterior.diagnostics import Decision, diagnose
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.posterior.run_folder import ASKED, RUN, begin_fit
from npdr_ppl.preparation.data_options import DataOptions, checked_options
from npdr_ppl.preparation.evaluation import score
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import claimed, write_json

if TYPE_CHECKING:
    from npdr_ppl.arviz_module import Data

__all__ = ["describe", "fit"]

FITS = ".fits"
"""Name of the folder in which an interrupted fit has kept the fits of its search."""


def fit(
    model: Model,
    train: Rollouts,
    test: Rollouts | None = None,
    *,
    out: Path | None = None,
    backend: str | Backend = "snpe-c",
    rounds: int = 1,
    extra_rounds: int = 2,
    num_simulations: int = 1_000,
    seed: int = 0,
    options: DataOptions | None = None,
    device: str = "cpu",
    progress: bool | Reporter | None = None,
) -> tuple[Posterior, dict[str, Any]]:
    """Fits a model to measured rollouts and reports on held-out ones.

    Args:
        model: A Pyro model with one black-box site.
        train: Rollouts to fit.
        test: Held-out rollouts to report on; the fitted ones if ``None``.
        out: Folder for ``posterior.nc``, ``fit.json`` and the run itself, from which an
            interrupted fit continues, and which refuses another one; until its end, the search
            for the closest parameters is kept there, too. Nothing is written if ``None``.
        backend: The inference backend.
        rounds: Rounds of simulating and training.
        extra_rounds: Rounds that the diagnosis may add where the estimator has not converged.
        num_simulations: Simulations of each round.
        seed: Seed of everything random.
        options: How the data are prepared.
        device: Where the backend trains.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The posterior and the content of ``fit.json``.
    """
    fits = None if out is None else out / FITS
    was_there = out is not None and out.exists()
    method = backend_by_name(backend) if isinstance(backend, str) else backend
    with reporter(progress) as report, claimed(out):
        if out is not None and isinstance(train, Rollouts):
            begin_fit(out, model, train, method, options, seed, num_simulations)
        try:
            with collect_faults() as before, keep_fits(fits, code_checksum(model)):
                prepared = prepare(
                    model,
                    train,
                    checked_options(options),
                    seed=seed,
                    progress=report.stage("find the closest parameters"),
                )
        except NpdrError:
            # A recording that does not fit the model leaves nothing; finished fits stay.
            if out is not None and not (out / FITS).exists():
                if not was_there:
                    shutil.rmtree(out, ignore_errors=True)
                elif not (out / RUN).exists():
                    (out / ASKED).unlink(missing_ok=True)
            raise
        options = prepared.options
        started = time.perf_counter()
        with ExitStack() as stack, collect_faults() as after:
            folder = (
                stack.enter_context(TemporaryDirectory(prefix="npdr-")) if out is None else out
            )
            left = extra_rounds if method.is_sequential else 0
            while True:
                posterior = infer(
                    prepared.model,
                    prepared.rollouts,
                    backend=method,
                    rounds=rounds,
                    num_simulations=num_simulations,
                    seed=seed,
                    preparation=prepared,
                    start=prepared.neighbourhood(),
                    device=device,
                    checkpoint=Path(folder) / RUN,
                    progress=report,
                )
                step = report.stage("sample and judge")
                step(None, "")
                data = posterior.to_arviz(seed=seed)
                diagnosis = diagnose(data, rounds_left=max(left, 1))
                if diagnosis.decision is not Decision.MORE_ROUNDS or left == 0:
                    break
                rounds, left = rounds + 1, left - 1
            step(None, "most likely draw")
            most_likely = posterior.most_likely(seed=seed)
            spent = sum(posterior.provenance.seconds.values())
            sampled = time.perf_counter() - started - spent
            step(None, "scores")
            evaluated = prepared.rollouts
            if test is not None:
                evaluated = prepared.repair.applied_to(test)
            metrics = score(prepared.model, evaluated, most_likely, options)
            step(1.0, "")
    # A resumed run knows the faults of its finished rounds from disk.
    faults = Counter(posterior.provenance.faults)
    for part in (before, after):
        faults.update(part.counts())
    result = {
        "backend": posterior.backend.name,
        **describe(data),
        "most_likely": {name: _plain(value) for name, value in most_likely.items()},
        "metrics": {
            "rmse": float(metrics["rmse"].mean()),
            "dtw": float(metrics["dtw"].mean()),
            "rmse_per_rollout": metrics["rmse"].tolist(),
            "dtw_per_rollout": metrics["dtw"].tolist(),
            "evaluated_on": "fitted" if test is None else "held-out",
        },
        "noise": prepared.noise,
        "preparation": prepared.summary.to_dict(),
        "finer_steps": num_finer_steps(prepared.plain_model),
        "checks": posterior.checks(),
        "seconds": {**posterior.provenance.seconds, "sample": sampled},
        "diagnosis": diagnosis.to_dict(),
        "units": parameter_units(posterior.prior),
    }
    if faults:
        result["faults"] = dict(faults)
    if settings := engine_settings(posterior.prior):
        result["engine"] = settings
    if out is not None:
        from npdr_ppl.arviz_module import to_netcdf

        out.mkdir(parents=True, exist_ok=True)
        to_netcdf(data, out / "posterior.nc")
        write_json(out / "fit.json", result)
    if fits is not None:
        shutil.rmtree(fits, ignore_errors=True)
    return posterior, result


def describe(data: "Data") -> dict[str, Any]:
    """Returns mean, standard deviation and 94 % highest-density interval of every parameter."""
    from npdr_ppl.arviz_module import group, hdi

    parameters: dict[str, Mapping[str, Any]] = {}
    posterior, intervals = group(data, "posterior"), hdi(data, 0.94)
    for name in posterior.data_vars:
        values = posterior[name]
        parameters[str(name)] = {
            "mean": _plain(values.mean(("chain", "draw"))),
            "sd": _plain(values.std(("chain", "draw"))),
            "hdi_94": _plain(intervals[name]),
        }
    return {"parameters": parameters}


def _plain(value: Any) -> Any:
    """Returns numbers for scalars and nested lists for arrays."""
    return np.asarray(value, dtype=float).tolist()
