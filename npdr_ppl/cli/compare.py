"""`npdr compare`: compares several backends on one model and one recording."""

from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.fit import InitialState, Noise, Precision
from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.names import (
    complete_backends,
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

__all__ = ["compare"]


def compare(
    model: Annotated[
        str,
        typer.Argument(
            help="Zoo name, or path/to/file.py:function.", autocompletion=complete_model
        ),
    ],
    data: Annotated[Path, typer.Option(help="Rollouts: CSV, Parquet, NPZ or NetCDF.")],
    backends: Annotated[
        str,
        typer.Option(
            help="Backends, e.g. 'snpe-c, small = snpe-c(flow=maf, members=1)'; see "
            "npdr backends.",
            autocompletion=complete_backends,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for results.")],
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of simulating and training.")] = 2,
    simulations: Annotated[int, typer.Option(min=10, help="Simulations per round.")] = 2_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    holdout: Annotated[str, typer.Option(help="Rollouts to evaluate on, e.g. 3,4.")] = "",
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
    """Compare inference backends with the same budget of simulations and the same seed.

    Each backend can have options, its own features (embedding=...) and a label. To continue an
    interrupted comparison, give the same command again; you may add backends.

    Example: npdr compare furuta --data measured.csv --backends "snpe-c, maf = snpe-c(flow=maf)"
    --segment-length 200 --holdout 3,4 --out comparison
    """
    from npdr_ppl.cli.resolve import (
        resolve_device,
        resolve_effects,
        resolve_model,
        resolve_rollouts,
    )
    from npdr_ppl.cli.show import show_comparison
    from npdr_ppl.display.plots.comparison_figures import write_comparison_figures
    from npdr_ppl.posterior.comparison.compare import compare as run_compare
    from npdr_ppl.posterior.comparison.compared_backends import candidates, split_candidates
    from npdr_ppl.preparation.data_options import DataOptions
    from npdr_ppl.progress import reporter

    device = resolve_device(device)
    chosen = resolve_effects(resolve_model(model), effect or [])
    named = candidates(split_candidates(backends))
    train, test = resolve_rollouts(data, holdout)
    with (
        resumable(f"the same command again continues the comparison in {out}."),
        reporter(False if quiet else None) as report,
        chosen_workers(executor, workers, address, time_limit),
    ):
        comparison = run_compare(
            chosen,
            train,
            test,
            backends=named,
            rounds=rounds,
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
            out=out,
            progress=report,
        )
        shown = train if test is None else test
        step = report.stage("draw figures")
        write_comparison_figures(comparison, chosen, shown, out, seed=seed, progress=step)
    if as_json:
        typer.echo((out / "comparison.json").read_text(), nl=False)
    elif not quiet:
        show_comparison(comparison.to_dict(), out)
