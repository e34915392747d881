"""`npdr fit`: a posterior from measured rollouts."""

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["fit"]


def fit(
    model: Annotated[str, typer.Argument(help="Zoo name, or path/to/file.py:function.")],
    data: Annotated[Path, typer.Option(help="Rollouts: CSV, Parquet, NPZ or NetCDF.")],
    out: Annotated[Path, typer.Option(help="Folder for results.")],
    backend: Annotated[str, typer.Option(help="Inference backend; see npdr backends.")] = "snpe-c",
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of simulating and training.")] = 2,
    simulations: Annotated[int, typer.Option(min=10, help="Simulations per round.")] = 2_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    holdout: Annotated[str, typer.Option(help="Rollouts to hold out, e.g. 3,4.")] = "",
    effect: Annotated[
        list[str] | None, typer.Option(help="Effect to attach, port.effect; may be repeated.")
    ] = None,
    embedding: Annotated[str, typer.Option(help="Trajectory features.")] = "bayessim",
    segment_length: Annotated[
        int, typer.Option(min=0, help="Steps between re-synchronisations; 0 for never.")
    ] = 0,
    initial_state: Annotated[
        str, typer.Option(help="State at a segment's start: estimated or recorded.")
    ] = "estimated",
    device: Annotated[str, typer.Option(help="Where to train: cpu or cuda.")] = "cpu",
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Infer the posterior over a model's parameters from measured rollouts.

    An interrupted run continues when the same command is given again.

    Example: npdr fit furuta --data measured.csv --segment-length 200 --holdout 3,4 --out fit
    """
    from npdr_ppl.cli.resolve import resolve_effects, resolve_model, resolve_rollouts
    from npdr_ppl.cli.show import show_fit
    from npdr_ppl.errors import DataError
    from npdr_ppl.workflows.fit import fit_and_write

    chosen = resolve_effects(resolve_model(model), effect or [])
    train, test = resolve_rollouts(data, holdout)
    if initial_state not in ("estimated", "recorded"):
        raise DataError(f"--initial-state is estimated or recorded, not {initial_state!r}.")
    result = fit_and_write(
        chosen,
        train,
        test,
        out,
        backend=backend,
        rounds=rounds,
        num_simulations=simulations,
        seed=seed,
        embedding=embedding,
        segment_length=segment_length or None,
        initial_state=initial_state,
        device=device,
        progress=False if quiet else None,
    )
    if not quiet:
        show_fit(result, out)
