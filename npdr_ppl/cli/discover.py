"""`npdr discover`: finds effects that a model lacks, adds them and tests them."""

from enum import StrEnum
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.names import complete_effect
from npdr_ppl.cli.options import (
    CommandsBefore,
    CommandsBeforeOption,
    DataOption,
    EffectOption,
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
    SeedOption,
    SegmentLengthOption,
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

__all__ = ["discover"]


class LastStage(StrEnum):
    """Last stage to run; each stage includes the earlier ones."""

    CHECK = "check"
    LOCATE = "locate"
    ALARM = "alarm"
    NAME = "name"
    PROVE = "prove"


class LawSymmetry(StrEnum):
    """Symmetry of a learned law under mirrored motion and commands."""

    ODD = "odd"
    EVEN = "even"


def discover(
    model: ModelArgument,
    data: DataOption,
    out: OutOption,
    mapping: MappingOption = None,
    holdout: HoldoutOption = None,
    holdout_data: HoldoutDataOption = None,
    effect: EffectOption = None,
    candidates: Annotated[
        list[str] | None,
        typer.Option(
            help="Effects to try, in the form of --effect; the catalogue if not given. Repeat the "
            "option, or separate by commas.",
            autocompletion=complete_effect,
        ),
    ] = None,
    segment_length: SegmentLengthOption = "auto",
    initial_state: InitialStateOption = InitialState.UNCERTAIN,
    precision: PrecisionOption = Precision.FLOAT64,
    noise: NoiseOption = Noise.AUTO,
    strict: StrictOption = False,
    commands_before: CommandsBeforeOption = CommandsBefore.AUTO,
    max_effects: Annotated[int, typer.Option(min=0, help="Maximum number of effects to add.")] = 5,
    false_alarm_rate: Annotated[
        float, typer.Option(help="Probability of an alarm if nothing is missing.")
    ] = 0.01,
    repeat: Annotated[
        bool,
        typer.Option(
            help="Name only effects that a half of the recording shows and that no part of it "
            "contradicts: neither half nor, with three rollouts or more, all but one rollout.",
        ),
    ] = True,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            help="If no effect explains the recording, learn a law, and write it as an effect.",
        ),
    ] = False,
    symmetry: Annotated[
        LawSymmetry | None,
        typer.Option(help="Symmetry of a learned law: odd like friction, or even."),
    ] = None,
    passive: Annotated[
        bool, typer.Option("--passive", help="A learned law only takes energy, as friction does.")
    ] = False,
    time_limit: Annotated[
        float | None,
        typer.Option(
            help="Seconds after which no further effect is searched. The result is then the best "
            "so far; the same command with a longer limit continues."
        ),
    ] = None,
    stage: Annotated[
        LastStage, typer.Option(help="Stop after this stage and write the results so far.")
    ] = LastStage.PROVE,
    seed: SeedOption = 0,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    address: Address = None,
    simulation_limit: SimulationLimit = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find effects that a model lacks, add them, and test the revised model on held-out data.

    Discovery always estimates initial states and noise, and always cuts the recording into short
    segments. Other values of --initial-state and --noise, and --segment-length 0, are refused.

    Writes discovery.json, revised_model.py (a model for every other command) and figures. The
    same command continues an interrupted search, or shows the result of a finished one.

    Example: npdr discover furuta --data measured.csv --holdout 3,4 --out discovery
    """
    from npdr_ppl.cli.effect_words import named_effects
    from npdr_ppl.cli.resolve import resolve_effects, resolve_model, resolve_rollouts
    from npdr_ppl.cli.show_discovery import show_discovery
    from npdr_ppl.discovery import DiscoveryOptions, Investigation
    from npdr_ppl.discovery.discovery_folder import DiscoveryFolder, findings_until
    from npdr_ppl.display.plots.discovery_figures import (
        write_discovery_figures,
        write_stage_figures,
    )
    from npdr_ppl.progress import reporter
    from npdr_ppl.run_files import claimed, reading_back

    chosen = resolve_effects(resolve_model(model), effect or [])
    train, test = resolve_rollouts(data, holdout, holdout_data=holdout_data, mapping=mapping)
    options = data_options(
        None, segment_length, initial_state, precision, noise, strict, commands_before
    )
    named = [word for word in candidates or () if word]
    search = DiscoveryOptions(
        effects=tuple(named_effects(named)) or None,
        max_effects=max_effects,
        false_alarm_rate=false_alarm_rate,
        repeat=repeat,
        learn=learn,
        symmetry=None if symmetry is None else symmetry.value,
        is_passive=passive,
        time_limit=time_limit,
    )
    folder = DiscoveryFolder(out)
    with claimed(out):
        folder.begin(chosen, train, test, options, search, seed=seed)
        found = folder.finished(stage.value)
        if found is None:
            with (
                resumable(f"the same command again continues the search in {out}."),
                folder.kept(),
                chosen_workers(executor, workers, address, simulation_limit),
            ):
                with reporter(False if quiet else None) as report:
                    investigation = Investigation(
                        chosen,
                        train,
                        holdout=test if stage is LastStage.PROVE else None,
                        options=options,
                        search=search,
                        seed=seed,
                        progress=report,
                    )
                    found, discovery = findings_until(investigation, stage.value)
                if discovery is None:
                    write_stage_figures(investigation, stage.value, out)
                else:
                    write_discovery_figures(discovery, out)
            folder.finish(found, discovery)
    if as_json:
        typer.echo((out / "discovery.json").read_text(), nl=False)
    elif not quiet:
        with reading_back(out / "discovery.json"):
            show_discovery(found, out)
