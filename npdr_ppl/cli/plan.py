"""`npdr plan`: designs the next recording."""

import json
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet
from npdr_ppl.cli.names import complete_model
from npdr_ppl.cli.options import EffectOption, OptionalRolloutsOption, OutOption, SeedOption
from npdr_ppl.errors import DataError

__all__ = ["plan"]


def plan(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="[RUN] MODEL",
            help="Folder of a run, if there is one, and the model that the run was given: zoo "
            "name, path/to/file.py:function, or a robot's MJCF or URDF file.",
            autocompletion=complete_model,
        ),
    ],
    out: OutOption = Path("trajectory.csv"),
    limits: Annotated[
        Path | None,
        typer.Option(
            help="TOML file of what the robot may do; what it does not name is as in the run's "
            "recording, or as the model declares."
        ),
    ] = None,
    print_limits: Annotated[
        bool,
        typer.Option("--print-limits", help="Print the limits as TOML, to edit them, and end."),
    ] = False,
    rollouts: OptionalRolloutsOption = None,
    effect: EffectOption = None,
    batches: Annotated[
        int, typer.Option(min=1, help="Batches of excitations that are tried.")
    ] = 30,
    search_time: Annotated[
        float,
        typer.Option(
            min=1.0,
            help="Seconds after which no further batch is tried. The result then depends on the "
            "speed of the machine.",
        ),
    ] = 75.0,
    seed: SeedOption = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Design the next recording: the commands that tell the causes apart which a run left.

    Of a run of discover that is ambiguous or unknown, it maximises how far the causes are apart,
    with their parameters refitted. Of other runs, and of a model without a run, it maximises the
    information about the parameters. Commands are band-limited, and simulations with all causes
    keep the limits.

    Example: npdr plan discovery furuta --limits limits.toml --out trajectory.csv
    """
    from npdr_ppl.cli.resolve import resolve_effects, resolve_model
    from npdr_ppl.cli.show_plan import show_plan
    from npdr_ppl.planning.causes import causes_of_prior, causes_of_run
    from npdr_ppl.planning.limits import default_limits, read_limits
    from npdr_ppl.planning.plan import plan_recording
    from npdr_ppl.progress import reporter

    if len(words) > 2:
        raise DataError(f"npdr plan takes a run and a model; it was given {', '.join(words)}.")
    chosen = resolve_effects(resolve_model(words[-1]), effect or [])
    known = (
        causes_of_run(Path(words[0]), chosen) if len(words) == 2 else causes_of_prior(chosen, seed)
    )
    simulator = known.causes[0].simulator
    defaults = default_limits(
        simulator, known.recorded, time_step=known.time_step, noise=known.noise
    )
    if print_limits:
        channels = (*simulator.sensors, *simulator.actions)
        typer.echo(defaults.toml({c.name: c.unit for c in channels}), nl=False)
        return
    allowed = read_limits(limits, defaults)
    if out.suffix.lower() != ".csv":
        raise DataError(f"{out} is no .csv file; npdr plan writes its commands as CSV.")
    if not out.parent.is_dir():
        raise DataError(f"{out.parent} is no folder; create it first.")
    if out.exists():
        raise DataError(f"{out} exists already; choose another name or remove it first.")
    with reporter(False if quiet or as_json else None) as report:
        found = plan_recording(
            known,
            allowed,
            rollouts=rollouts,
            rounds=batches,
            time_limit=search_time,
            seed=seed,
            progress=report.stage("plan", may_end_early=True),
        )
    found.recording.to_csv(out)
    if as_json:
        told = {"file": str(out), **found.to_dict()}
        typer.echo(json.dumps(told, ensure_ascii=False, indent=2))
    elif not quiet:
        show_plan(found.to_dict(), out)
