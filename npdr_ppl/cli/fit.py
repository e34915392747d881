"""`npdr fit`: infers a posterior from measured rollouts."""

from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.options import (
    BackendOption,
    CommandsBefore,
    CommandsBeforeOption,
    DataOption,
    DeviceOption,
    EffectOption,
    EmbeddingOption,
    HoldoutDataOption,
    HoldoutOption,
    InitialState,
    InitialStateOption,
    MappingOption,
    ModelArgument,
    Noise,
    NoiseOption,
    OutOption,
    Precision,
    PrecisionOption,
    RoundsOption,
    SeedOption,
    SegmentLengthOption,
    SimulationsOption,
    StrictOption,
    data_options,
)
from npdr_ppl.cli.worker_options import (
    Address,
    ExecutorOption,
    SimulationLimit,
    WorkersOption,
    chosen_workers,
)

__all__ = ["fit"]


def fit(
    model: ModelArgument,
    data: DataOption,
    out: OutOption,
    backend: BackendOption = "snpe-c",
    rounds: RoundsOption = 1,
    extra_rounds: Annotated[
        int, typer.Option(min=0, help="Rounds to add if the estimator has not converged.")
    ] = 2,
    simulations: SimulationsOption = 1_000,
    seed: SeedOption = 0,
    mapping: MappingOption = None,
    holdout: HoldoutOption = None,
    holdout_data: HoldoutDataOption = None,
    effect: EffectOption = None,
    embedding: EmbeddingOption = "score",
    segment_length: SegmentLengthOption = "auto",
    initial_state: InitialStateOption = InitialState.UNCERTAIN,
    precision: PrecisionOption = Precision.FLOAT64,
    noise: NoiseOption = Noise.AUTO,
    strict: StrictOption = False,
    commands_before: CommandsBeforeOption = CommandsBefore.AUTO,
    device: DeviceOption = "cpu",
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    address: Address = None,
    simulation_limit: SimulationLimit = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Infer the posterior over a model's parameters from measured rollouts.

    To continue an interrupted run, give the same command again.

    Example: npdr fit furuta --data measured.csv --segment-length 200 --holdout 3,4 --out fit
    """
    from npdr_ppl.cli.resolve import (
        resolve_backend,
        resolve_device,
        resolve_effects,
        resolve_model,
        resolve_rollouts,
    )
    from npdr_ppl.cli.show import show_fit
    from npdr_ppl.display.plots.fit_figures import write_fit_figures
    from npdr_ppl.posterior.fit import fit as run_fit
    from npdr_ppl.progress import reporter

    device = resolve_device(device)
    chosen = resolve_effects(resolve_model(model), effect or [])
    method, features = resolve_backend(backend, embedding)
    options = data_options(
        features, segment_length, initial_state, precision, noise, strict, commands_before
    )
    train, test = resolve_rollouts(data, holdout, holdout_data=holdout_data, mapping=mapping)
    with (
        resumable(f"the same command again continues the run in {out}."),
        reporter(False if quiet else None) as report,
        chosen_workers(executor, workers, address, simulation_limit),
    ):
        posterior, result = run_fit(
            chosen,
            train,
            test,
            out=out,
            backend=method,
            rounds=rounds,
            extra_rounds=extra_rounds,
            num_simulations=simulations,
            seed=seed,
            options=options,
            device=device,
            progress=report,
        )
        prepared = posterior.preparation
        shown = train if test is None else test
        if prepared is not None:
            shown = prepared.rollouts if test is None else prepared.repair.applied_to(test)
        step = report.stage("draw figures")
        write_fit_figures(posterior, chosen, shown, out, seed=seed, progress=step)
    if as_json:
        typer.echo((out / "fit.json").read_text(), nl=False)
    elif not quiet:
        show_fit(result, out)
