"""`npdr fit`: infers a posterior from measured rollouts."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.names import (
    complete_backend,
    complete_effect,
    complete_embedding,
    complete_model,
)
from npdr_ppl.cli.segment_length import SegmentLengthOption, resolve_segment_length
from npdr_ppl.cli.worker_options import (
    Address,
    ExecutorOption,
    TimeLimit,
    WorkersOption,
    chosen_workers,
)

__all__ = ["InitialState", "fit"]


class InitialState(StrEnum):
    """How the state at a segment's start is obtained."""

    ESTIMATED = "estimated"
    RECORDED = "recorded"
    UNCERTAIN = "uncertain"


class Precision(StrEnum):
    """Floating-point type."""

    FLOAT64 = "float64"
    FLOAT32 = "float32"


class Noise(StrEnum):
    """Source of the measurement noise."""

    AUTO = "auto"
    MODEL = "model"


def fit(
    model: Annotated[
        str,
        typer.Argument(
            help="Zoo name, or path/to/file.py:function.", autocompletion=complete_model
        ),
    ],
    data: Annotated[Path, typer.Option(help="Rollouts: CSV, Parquet, NPZ or NetCDF.")],
    out: Annotated[Path, typer.Option(help="Folder for results.")],
    backend: Annotated[
        str,
        typer.Option(
            help="Inference backend; see npdr backends.", autocompletion=complete_backend
        ),
    ] = "snpe-c",
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of simulating and training.")] = 1,
    extra_rounds: Annotated[
        int, typer.Option(min=0, help="Rounds to add if the estimator has not converged.")
    ] = 2,
    simulations: Annotated[int, typer.Option(min=10, help="Simulations per round.")] = 1_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    holdout: Annotated[str, typer.Option(help="Rollouts to hold out, e.g. 3,4.")] = "",
    effect: Annotated[
        list[str] | None,
        typer.Option(
            help="Effect to attach, port.effect; may be repeated.", autocompletion=complete_effect
        ),
    ] = None,
    embedding: Annotated[
        str,
        typer.Option(
            help="Trajectory features: score, all/50, gru/10, bayessim, ...",
            autocompletion=complete_embedding,
        ),
    ] = "score",
    segment_length: SegmentLengthOption = "auto",
    initial_state: Annotated[
        InitialState, typer.Option(help="State at a segment's start.")
    ] = InitialState.UNCERTAIN,
    precision: Annotated[
        Precision, typer.Option(help="Floating-point type of the simulation.")
    ] = Precision.FLOAT64,
    noise: Annotated[
        Noise, typer.Option(help="Measurement noise: auto estimates it, model keeps the model's.")
    ] = Noise.AUTO,
    device: Annotated[str, typer.Option(help="Where to train: cpu or cuda.")] = "cpu",
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    address: Address = None,
    time_limit: TimeLimit = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Infer the posterior over a model's parameters from measured rollouts.

    To continue an interrupted run, give the same command again.

    Example: npdr fit furuta --data measured.csv --segment-length 200 --holdout 3,4 --out fit
    """
    from npdr_ppl.cli.resolve import (
        resolve_device,
        resolve_effects,
        resolve_model,
        resolve_rollouts,
    )
    from npdr_ppl.cli.show import show_fit
    from npdr_ppl.display.plots.fit_figures import write_fit_figures
    from npdr_ppl.posterior.fit import fit as run_fit
    from npdr_ppl.preparation.data_options import DataOptions
    from npdr_ppl.progress import reporter

    device = resolve_device(device)
    chosen = resolve_effects(resolve_model(model), effect or [])
    train, test = resolve_rollouts(data, holdout)
    with (
        resumable(f"the same command again continues the run in {out}."),
        reporter(False if quiet else None) as report,
        chosen_workers(executor, workers, address, time_limit),
    ):
        posterior, result = run_fit(
            chosen,
            train,
            test,
            out=out,
            backend=backend,
            rounds=rounds,
            extra_rounds=extra_rounds,
            num_simulations=simulations,
            seed=seed,
            options=DataOptions(
                embedding,
                resolve_segment_length(segment_length),
                initial_state.value,
                precision.value,
                noise.value,
            ),
            device=device,
            progress=report,
        )
        shown = train if test is None else test
        step = report.stage("draw figures")
        write_fit_figures(posterior, chosen, shown, out, seed=seed, progress=step)
    if as_json:
        typer.echo((out / "fit.json").read_text(), nl=False)
    elif not quiet:
        show_fit(result, out)
