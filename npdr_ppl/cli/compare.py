"""`npdr compare`: compares several backends on one model and one recording."""

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.options import (
    BackendsOption,
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

__all__ = ["compare"]


def compare(
    model: ModelArgument,
    data: DataOption,
    backends: BackendsOption,
    out: OutOption,
    rounds: RoundsOption = 2,
    simulations: SimulationsOption = 2_000,
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
    from npdr_ppl.progress import reporter

    device = resolve_device(device)
    chosen = resolve_effects(resolve_model(model), effect or [])
    named = candidates(split_candidates(backends))
    options = data_options(
        embedding, segment_length, initial_state, precision, noise, strict, commands_before
    )
    train, test = resolve_rollouts(data, holdout, holdout_data=holdout_data, mapping=mapping)
    with (
        resumable(f"the same command again continues the comparison in {out}."),
        reporter(False if quiet else None) as report,
        chosen_workers(executor, workers, address, simulation_limit),
    ):
        comparison = run_compare(
            chosen,
            train,
            test,
            backends=named,
            rounds=rounds,
            num_simulations=simulations,
            seed=seed,
            options=options,
            device=device,
            out=out,
            progress=report,
        )
        prepared = comparison.error_model.prepared
        shown = train if test is None else test
        if prepared is not None:
            shown = prepared.rollouts if test is None else prepared.repair.applied_to(test)
        step = report.stage("draw figures")
        write_comparison_figures(comparison, chosen, shown, out, seed=seed, progress=step)
    if as_json:
        typer.echo((out / "comparison.json").read_text(), nl=False)
    elif not quiet:
        show_comparison(comparison.to_dict(), out)
