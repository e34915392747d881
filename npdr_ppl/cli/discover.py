"""`npdr discover`: finds effects that a model lacks, adds them and tests them."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.names import complete_effect, complete_model
from npdr_ppl.cli.worker_options import (
    Address,
    ExecutorOption,
    TimeLimit,
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


def discover(
    model: Annotated[
        str,
        typer.Argument(
            help="Zoo name, or path/to/file.py:function.", autocompletion=complete_model
        ),
    ],
    data: Annotated[Path, typer.Option(help="Rollouts: CSV, Parquet, NPZ or NetCDF.")],
    out: Annotated[Path, typer.Option(help="Folder for results.")],
    holdout: Annotated[str, typer.Option(help="Rollouts to test on, e.g. 3,4.")] = "",
    holdout_data: Annotated[
        Path | None,
        typer.Option(help="File of held-out rollouts; best with another excitation."),
    ] = None,
    segment_length: Annotated[
        int, typer.Option(min=0, help="Steps between re-synchronisations; 0 for 0.2 s.")
    ] = 0,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            help="Effect that the model already has, port.effect; may be repeated.",
            autocompletion=complete_effect,
        ),
    ] = None,
    effects: Annotated[
        str,
        typer.Option(
            help="Effects to try, port.effect,port.effect; all if not given.",
            autocompletion=complete_effect,
        ),
    ] = "",
    max_effects: Annotated[int, typer.Option(min=0, help="Maximum number of effects to add.")] = 5,
    false_alarm_rate: Annotated[
        float, typer.Option(help="Probability of an alarm if nothing is missing.")
    ] = 0.01,
    stage: Annotated[
        LastStage, typer.Option(help="Stop after this stage and write the results so far.")
    ] = LastStage.PROVE,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    address: Address = None,
    time_limit: TimeLimit = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find effects that a model lacks, add them, and test the revised model on held-out data.

    Writes discovery.json, revised_model.py (a model for every other command) and figures. The
    same command continues an interrupted search, or shows the result of a finished one.

    Example: npdr discover furuta --data measured.csv --holdout 3,4 --out discovery
    """
    from npdr_ppl.cli.resolve import (
        named_effects,
        resolve_effects,
        resolve_holdout,
        resolve_model,
    )
    from npdr_ppl.cli.show import show_discovery
    from npdr_ppl.discovery import DiscoveryOptions, Investigation
    from npdr_ppl.discovery.discovery_folder import DiscoveryFolder, findings_until
    from npdr_ppl.discovery.search_progress import sentences
    from npdr_ppl.display.plots.discovery_figures import (
        write_discovery_figures,
        write_stage_figures,
    )
    from npdr_ppl.run_files import claimed

    chosen = resolve_effects(resolve_model(model), effect or [])
    train, test = resolve_holdout(data, holdout, holdout_data)
    options = DiscoveryOptions(
        segment_length=segment_length or None,
        effects=tuple(named_effects([effects])) if effects else None,
        max_effects=max_effects,
        false_alarm_rate=false_alarm_rate,
        seed=seed,
    )
    folder = DiscoveryFolder(out)
    with claimed(out):
        folder.begin(chosen, train, test, options)
        found = folder.finished(stage.value)
        if found is None:
            with (
                resumable(f"the same command again continues the search in {out}."),
                folder.kept(),
                chosen_workers(executor, workers, address, time_limit),
            ):
                with sentences(options, False if quiet else None) as report:
                    investigation = Investigation(
                        chosen,
                        train,
                        holdout=test if stage is LastStage.PROVE else None,
                        options=options,
                        report=report,
                    )
                    found, discovery = findings_until(investigation, stage.value)
                if discovery is None:
                    write_stage_figures(investigation, stage.value, out)
                else:
                    write_discovery_figures(discovery, out)
            folder.finish(found, None if discovery is None else discovery.source())
    if as_json:
        typer.echo((out / "discovery.json").read_text(), nl=False)
    elif not quiet:
        show_discovery(found, out)
