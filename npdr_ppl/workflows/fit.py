"""`npdr fit` as a function: infer, evaluate, diagnose, draw, and write it all down."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from npdr_ppl.engines.workers import collect_faults
from npdr_ppl.inference.base import Backend
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.closest_fit import prepare
from npdr_ppl.workflows.diagnostics import diagnose
from npdr_ppl.workflows.evaluation import score
from npdr_ppl.workflows.infer import infer
from npdr_ppl.workflows.posterior import Posterior
from npdr_ppl.workflows.progress import Reporter, reporter
from npdr_ppl.workflows.run_folder import engine_settings, write_json
from npdr_ppl.workflows.units import parameter_units

if TYPE_CHECKING:
    from npdr_ppl.workflows.arviz_module import Data

__all__ = ["describe", "fit"]


def fit(
    model: Callable[..., Any],
    train: Rollouts,
    test: Rollouts | None = None,
    *,
    out: Path | None = None,
    backend: str | Backend = "snpe-c",
    rounds: int = 2,
    num_simulations: int = 2_000,
    seed: int = 0,
    options: BindingOptions | None = None,
    noise: Literal["auto", "model"] = "auto",
    device: str = "cpu",
    progress: bool | Reporter | None = None,
) -> tuple[Posterior, dict[str, Any]]:
    """Fits a model to measured rollouts and reports on held-out ones.

    Args:
        model: A Pyro model with one black-box site.
        train: Rollouts to fit.
        test: Held-out rollouts to report on; the fitted ones if ``None``.
        out: Folder for ``posterior.nc``, ``fit.json`` and the run itself, from which an
            interrupted fit continues; nothing is written if ``None``.
        backend: The inference backend.
        rounds: Rounds of simulating and training.
        num_simulations: Simulations of each round.
        seed: Seed of everything random.
        options: How the data are prepared.
        noise: ``"auto"`` gives a model without noise the scale of
            :func:`~npdr_ppl.workflows.closest_fit.closest_fit`; ``"model"`` takes it as it is.
        device: Where the backend trains.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The posterior and the content of ``fit.json``.
    """
    with reporter(progress) as report:
        with collect_faults() as before:
            prepared = prepare(
                model,
                train,
                options or BindingOptions(),
                noise=noise,
                seed=seed,
                progress=report.stage("find the closest parameters"),
            )
        options = prepared.options
        posterior = infer(
            prepared.model,
            train,
            backend=backend,
            rounds=rounds,
            num_simulations=num_simulations,
            seed=seed,
            embedding=options.embedding,
            segment_length=options.segment_length,
            initial_state=options.initial_state,
            precision=options.precision,
            device=device,
            checkpoint=None if out is None else out / "run",
            progress=report,
        )
        step = report.stage("sample and judge")
        started = time.perf_counter()
        with collect_faults() as after:
            step(0.0, "most likely draw")
            most_likely = posterior.most_likely(seed=seed)
            step(0.1, "predictions")
            data = posterior.to_arviz(seed=seed)
            sampled = time.perf_counter() - started
            step(0.8, "scores")
            evaluated = train if test is None else test
            metrics = score(model, evaluated, most_likely, options)
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
        "seconds": {**posterior.provenance.seconds, "sample": sampled},
        "diagnosis": diagnose(data).to_dict(),
        "units": parameter_units(posterior),
    }
    if faults:
        result["faults"] = dict(faults)
    if settings := engine_settings(posterior.prior):
        result["engine"] = settings
    if out is not None:
        from npdr_ppl.workflows.arviz_module import to_netcdf

        out.mkdir(parents=True, exist_ok=True)
        to_netcdf(data, out / "posterior.nc")
        write_json(out / "fit.json", result)
    return posterior, result


def describe(data: "Data") -> dict[str, Any]:
    """Returns mean, standard deviation and 94 % highest-density interval of every parameter."""
    from npdr_ppl.workflows.arviz_module import group, hdi

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
