"""`npdr train`: trains a policy for a device that differs from its simulator."""

from enum import StrEnum
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.names import complete_search, complete_target, complete_task
from npdr_ppl.cli.options import (
    BackendOption,
    CommandsBefore,
    CommandsBeforeOption,
    EffectOption,
    EmbeddingOption,
    InitialState,
    InitialStateOption,
    ModelArgument,
    Noise,
    NoiseOption,
    OutOption,
    Precision,
    PrecisionOption,
    RolloutsOption,
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

__all__ = ["train"]


class InternalModel(StrEnum):
    """Parameters of the model inside the policy when it runs on the target."""

    MOST_LIKELY = "most-likely"
    NOMINAL = "nominal"


def train(
    model: ModelArgument,
    target: Annotated[
        str,
        typer.Option(
            help="Device to control: a target of the zoo (see npdr targets), a file of "
            "rollouts, gym:ENVIRONMENT, or path/to/file.py:function.",
            autocompletion=complete_target,
        ),
    ],
    out: OutOption,
    task: Annotated[
        str,
        typer.Option(
            help="Control task: see npdr tasks, or path/to/file.py:function; the model's "
            "default task if not given.",
            autocompletion=complete_task,
        ),
    ] = "",
    backend: BackendOption = "snpe-c",
    search: Annotated[
        str,
        typer.Option(
            help="Policy search, e.g. power(population=100); see npdr searches.",
            autocompletion=complete_search,
        ),
    ] = "power",
    iterations: Annotated[int, typer.Option(min=1, help="Iterations of the loop.")] = 5,
    rollouts: RolloutsOption = 1,
    rounds: RoundsOption = 3,
    simulations: SimulationsOption = 5_000,
    seed: SeedOption = 0,
    effect: EffectOption = None,
    embedding: EmbeddingOption = "score",
    segment_length: SegmentLengthOption = "50",
    initial_state: InitialStateOption = InitialState.UNCERTAIN,
    precision: PrecisionOption = Precision.FLOAT32,
    noise: NoiseOption = Noise.AUTO,
    strict: StrictOption = False,
    commands_before: CommandsBeforeOption = CommandsBefore.AUTO,
    search_iterations: Annotated[
        int, typer.Option(min=1, help="Iterations of each policy search.")
    ] = 20,
    domains: Annotated[
        int, typer.Option(min=1, help="Number of domains to train the policy in.")
    ] = 50,
    spread: Annotated[
        float, typer.Option(min=0, max=1, help="Spread of the domains around the posterior.")
    ] = 0.1,
    internal_model: Annotated[
        InternalModel, typer.Option(help="Parameters of the model inside the policy.")
    ] = InternalModel.MOST_LIKELY,
    decisions: Annotated[
        bool,
        typer.Option("--decisions/--no-decisions", help="Act on diagnoses, or only log them."),
    ] = True,
    extra_rollouts: Annotated[
        int,
        typer.Option(
            min=0, help="Maximum total of real rollouts that diagnoses and checks may add."
        ),
    ] = 0,
    least_success: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Share of episodes in posterior draws that must succeed before a policy "
            "runs on the target; else record another rollout, or train for the worst domains.",
        ),
    ] = 0.9,
    tail_share: Annotated[
        float,
        typer.Option(min=0, max=1, help="Share of the domains that are treated as the worst."),
    ] = 0.2,
    discover: Annotated[
        bool,
        typer.Option(
            "--discover",
            help="Search the real rollouts for effects that the model lacks, and add them.",
        ),
    ] = False,
    stop_return: Annotated[
        float | None, typer.Option(help="Stop at this real return, if the posterior is accepted.")
    ] = None,
    animate: Annotated[
        bool, typer.Option("--animate", help="Draw the last rollout as rollout.gif (Furuta only).")
    ] = False,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    address: Address = None,
    simulation_limit: SimulationLimit = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Train a policy for a target domain in a loop: run it, infer parameters, train it.

    Rollouts on the target give a posterior, and the policy is trained in simulators drawn from it.
    With --discover, effects that the model lacks are added. Before a policy runs on the target, it
    is tested in simulators drawn from the posterior.

    To continue an interrupted run, give the same command again; you may add iterations.

    Example: npdr train furuta --target furuta-hard --effect arm.coulomb_friction
    --effect pole.coulomb_friction --iterations 3 --out run
    """
    from npdr_ppl.cli.resolve import (
        resolve_backend,
        resolve_effects,
        resolve_model,
        resolve_search,
        resolve_target,
        resolve_task,
    )
    from npdr_ppl.cli.show import show_training
    from npdr_ppl.display.plots.furuta_animation import check_animated, write_furuta_animation
    from npdr_ppl.display.plots.training_figures import last_rollout, write_training_figures
    from npdr_ppl.errors import DataError
    from npdr_ppl.loop.loop_options import LoopOptions
    from npdr_ppl.loop.npdr_loop import train as run_train
    from npdr_ppl.progress import reporter

    chosen = resolve_effects(resolve_model(model), effect or [])
    chosen_task = resolve_task(task, model)
    method, features = resolve_backend(backend, embedding)
    device = resolve_target(target)
    if device.num_episodes is not None and rollouts > device.num_episodes:
        raise DataError(
            f"{target} has {device.num_episodes} rollouts, too few for --rollouts {rollouts}."
        )
    if animate:
        check_animated([sensor.name for sensor in device.sensors])
    options = data_options(
        features, segment_length, initial_state, precision, noise, strict, commands_before
    )
    loop = LoopOptions(
        iterations=iterations,
        rollouts=rollouts,
        extra_rollouts=extra_rollouts,
        backend=method,
        rounds=rounds,
        num_simulations=simulations,
        search=resolve_search(search),
        search_iterations=search_iterations,
        num_domains=domains,
        spread=spread,
        internal_model=(
            "most likely" if internal_model is InternalModel.MOST_LIKELY else "nominal"
        ),
        follows_decisions=decisions,
        stop_return=stop_return,
        least_success=least_success,
        tail_share=tail_share,
        discovers="before inference" if discover else "never",
    )
    with resumable(f"the same command again continues the run in {out}."):
        with (
            reporter(False if quiet else None) as report,
            chosen_workers(executor, workers, address, simulation_limit),
        ):
            training = run_train(
                chosen,
                device,
                chosen_task,
                options=options,
                loop=loop,
                out=out,
                seed=seed,
                progress=report,
            )
            step = report.stage("draw figures")
            step(None, "returns, rollouts, parameters")
            write_training_figures(training, device, chosen_task, out)
            step(1.0, "")
    if animate:
        rollout = training.rollouts[[last_rollout(training.iterations)]]
        write_furuta_animation(rollout, out / "rollout.gif", domain=training.domain)
    if as_json:
        typer.echo((out / "train.json").read_text(), nl=False)
    elif not quiet:
        show_training(training.to_dict(), out)
