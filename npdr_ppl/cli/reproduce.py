"""`npdr reproduce`: repeats the paper's experiments."""

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from npdr_ppl.cli.manners import AsJson, Quiet, Verbose, resumable
from npdr_ppl.cli.options import (
    BackendsOption,
    InitialState,
    InitialStateOption,
    OptionalDataOption,
    OptionalRoundsOption,
    OptionalSimulationsOption,
    OutOption,
    SeedOption,
)

__all__ = ["reproduce"]


class Experiment(StrEnum):
    """An experiment of Muratore et al. (2021), or one that uses its recordings."""

    TABLE2 = "table2"
    PENDULUM = "pendulum"
    MINI_GOLF = "mini-golf"
    MISSING_EFFECT = "missing-effect"


def reproduce(
    experiment: Annotated[Experiment, typer.Argument(help="Which table or figure.")],
    data: OptionalDataOption = None,
    out: OutOption = Path("reproduction"),
    backends: BackendsOption = "",
    initial_state: InitialStateOption = InitialState.RECORDED,
    returns: Annotated[
        int,
        typer.Option(
            min=0,
            help="table2: training runs per method for the rows with returns, on a hidden rig "
            "in MuJoCo; each takes minutes. 0 leaves these rows out.",
        ),
    ] = 0,
    rounds: OptionalRoundsOption = None,
    simulations: OptionalSimulationsOption = None,
    seed: SeedOption = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Reproduce an experiment of the NPDR paper, and compare with its published numbers.

    table2, mini-golf and missing-effect need the paper's recordings in --data; missing-effect also
    takes a folder with two recordings. All methods of the paper run unless --backends chooses
    some, with recorded initial states as in the paper. A flag that has no effect on an experiment
    is refused. To continue an interrupted experiment, give the same command again.

    Example: npdr reproduce table2 --data swing_up_500hz_5s.csv --out table2
    """
    given = {
        "--backends": bool(backends),
        "--initial-state": initial_state is not InitialState.RECORDED,
        "--returns": bool(returns),
        "--rounds": rounds is not None,
        "--simulations": simulations is not None,
    }
    _check_flags(experiment, [flag for flag, is_given in given.items() if is_given])
    if experiment is Experiment.MISSING_EFFECT:
        _reproduce_missing_effect(_only(data), out / experiment.value, seed, as_json, quiet)
        return
    from npdr_ppl.cli.show import show_rows
    from npdr_ppl.errors import DataError
    from npdr_ppl.posterior.comparison.compared_backends import split_candidates

    progress = False if quiet else None
    file = _only(data)
    out = out / experiment.value
    chosen = split_candidates(backends) if backends else None
    with resumable(f"the same command again continues the experiment in {out}."):
        if experiment is Experiment.PENDULUM:
            from npdr_ppl.display.plots.pendulum_figure import write_pendulum_figures
            from npdr_ppl.reproduction.pendulum_ridge import reproduce_pendulum

            ridges, result = reproduce_pendulum(out, backends=chosen, seed=seed, progress=progress)
            write_pendulum_figures(ridges, out)
        elif experiment is Experiment.MINI_GOLF:
            from npdr_ppl.display.plots.mini_golf_figure import write_mini_golf_figures
            from npdr_ppl.reproduction.mini_golf_table import reproduce_mini_golf
            from npdr_ppl.rollouts import Rollouts

            if file is None:
                raise DataError("mini-golf needs the paper's recordings: pass --data FILE.")
            posteriors, result = reproduce_mini_golf(
                Rollouts.load(file),
                out,
                backends=chosen,
                rounds=rounds,
                num_simulations=simulations,
                seed=seed,
                progress=progress,
            )
            write_mini_golf_figures(
                {label: p[-1] for label, p in posteriors.items()}, out, seed=seed
            )
        else:
            from npdr_ppl.display.plots.comparison_figures import write_comparison_figures
            from npdr_ppl.models.furuta import furuta
            from npdr_ppl.reproduction.table2 import add_returns, reproduce_table2
            from npdr_ppl.rollouts import Rollouts

            if file is None:
                raise DataError("table2 needs the paper's recordings: pass --data FILE.")
            rollouts = Rollouts.load(file)
            comparison, result = reproduce_table2(
                rollouts,
                out,
                backends=chosen,
                initial_state=initial_state.value,
                seed=seed,
                progress=progress,
            )
            held_out = rollouts[result["held_out"]]
            write_comparison_figures(comparison, furuta, held_out, out, seed=seed)
            if returns:
                result = add_returns(result, out, num_seeds=returns, progress=progress)
    if as_json:
        typer.echo((out / f"{experiment.value}.json").read_text(), nl=False)
    elif not quiet:
        show_rows(experiment.value, result)


def _only(data: Sequence[Path] | None) -> Path | None:
    """Returns the only file or folder that was given, ``None`` if none was."""
    from npdr_ppl.errors import DataError

    if data and len(data) > 1:
        raise DataError("an experiment takes --data once; a folder may hold several recordings.")
    return data[0] if data else None


def _check_flags(experiment: Experiment, given: Sequence[str]) -> None:
    """Raises an error for a flag that would have no effect."""
    from npdr_ppl.errors import DataError

    own = {
        Experiment.TABLE2: ("--backends", "--initial-state", "--returns"),
        Experiment.PENDULUM: ("--backends",),
        Experiment.MINI_GOLF: ("--backends", "--rounds", "--simulations"),
        Experiment.MISSING_EFFECT: (),
    }
    for flag in given:
        if flag not in own[experiment]:
            others = ", ".join(name for name, flags in own.items() if flag in flags)
            raise DataError(f"{flag} has no effect on {experiment}; it belongs to {others}.")


def _reproduce_missing_effect(
    data: Path | None, out: Path, seed: int, as_json: bool, quiet: bool
) -> None:
    from npdr_ppl.cli.show import show_missing_effect
    from npdr_ppl.display.plots.missing_effect_figures import write_missing_effect_figures
    from npdr_ppl.engines.workers import workers
    from npdr_ppl.errors import DataError
    from npdr_ppl.reproduction.missing_effect import load_recordings, reproduce_missing_effect
    from npdr_ppl.run_files import read_json, reading_back
    from npdr_ppl.run_records import DiscoveryRecord

    if data is None:
        raise DataError("missing-effect needs the paper's recordings: pass --data FOLDER.")
    swing_ups, chirps = load_recordings(data)
    with resumable(f"the same command again continues the search in {out}."), workers():
        story, result = reproduce_missing_effect(
            swing_ups,
            chirps,
            out,
            seed=seed,
            progress=False if quiet else None,
        )
        if story is not None:
            held_out = swing_ups[result["held_out"]]
            write_missing_effect_figures(story, held_out, chirps, out)
    if as_json:
        typer.echo((out / "missing-effect.json").read_text(), nl=False)
    elif not quiet:
        with reading_back(out):
            found = read_json(out / "discovery.json", DiscoveryRecord)
            show_missing_effect(found, result, out)
