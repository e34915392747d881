"""Options that several commands of `npdr` share, each declared once.

A flag therefore has the same type and help in every command; a test compares all commands. Options
that say how to print are in :mod:`npdr_ppl.cli.manners`, those that say where simulations run in
:mod:`npdr_ppl.cli.worker_options`.
"""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from npdr_ppl.cli.names import (
    complete_backend,
    complete_backends,
    complete_effect,
    complete_embedding,
    complete_model,
)
from npdr_ppl.errors import DataError

if TYPE_CHECKING:
    from npdr_ppl.embeddings import Embedding
    from npdr_ppl.preparation.data_options import DataOptions, SegmentLength

__all__ = [
    "BackendOption",
    "BackendsOption",
    "CommandsBefore",
    "CommandsBeforeOption",
    "DataOption",
    "DeviceOption",
    "EffectOption",
    "EmbeddingOption",
    "HoldoutDataOption",
    "HoldoutOption",
    "InitialState",
    "InitialStateOption",
    "MappingOption",
    "ModelArgument",
    "Noise",
    "NoiseOption",
    "OptionalDataOption",
    "OptionalModelArgument",
    "OptionalRoundsOption",
    "OptionalSimulationsOption",
    "OptionalRolloutsOption",
    "OutOption",
    "RolloutsOption",
    "Precision",
    "PrecisionOption",
    "RoundsOption",
    "SeedOption",
    "SegmentLengthOption",
    "SimulationsOption",
    "StrictOption",
    "data_options",
    "resolve_segment_length",
]


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


class CommandsBefore(StrEnum):
    """Commands before a rollout."""

    AUTO = "auto"
    ZERO = "zero"
    FIRST = "first"


_DATA = typer.Option(
    help="Rollouts: CSV, Parquet, NPZ or NetCDF; a log with --mapping. May be repeated."
)
_ROUNDS = typer.Option(min=1, help="Rounds of simulating and training.")
_SIMULATIONS = typer.Option(min=10, help="Simulations per round.")

_MODEL = typer.Argument(
    help="Zoo name, path/to/file.py:function, or a robot's MJCF or URDF file.",
    autocompletion=complete_model,
)

ModelArgument = Annotated[str, _MODEL]
OptionalModelArgument = Annotated[str | None, _MODEL]
DataOption = Annotated[list[Path], _DATA]
OptionalDataOption = Annotated[list[Path] | None, _DATA]
MappingOption = Annotated[
    Path | None,
    typer.Option(help="TOML file that maps the signals of logs; see npdr inspect --write."),
]
OutOption = Annotated[
    Path,
    typer.Option(
        help="Folder for results; file for the rollouts of convert and the commands of plan."
    ),
]
_ROLLOUTS = typer.Option(
    min=1,
    help="Rollouts to record: by train in each iteration; for plan, by default one, or to tell "
    "causes apart as many as are needed, in all at most two minutes.",
)
RolloutsOption = Annotated[int, _ROLLOUTS]
OptionalRolloutsOption = Annotated[int | None, _ROLLOUTS]
HoldoutOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Rollouts to hold out and to test on, e.g. 3,4; counted from 0. Repeat the option "
        "or separate by commas."
    ),
]
HoldoutDataOption = Annotated[
    Path | None,
    typer.Option(
        help="File whose rollouts are all held out to test on, instead of --holdout; best with "
        "other commands."
    ),
]
BackendOption = Annotated[
    str,
    typer.Option(
        help="Inference backend, e.g. snpe-c or snpe-c(flow=maf); see npdr backends.",
        autocompletion=complete_backend,
    ),
]
BackendsOption = Annotated[
    str,
    typer.Option(
        help="Backends, e.g. 'snpe-c, small = snpe-c(flow=maf, members=1)'; see npdr backends.",
        autocompletion=complete_backends,
    ),
]
RoundsOption = Annotated[int, _ROUNDS]
OptionalRoundsOption = Annotated[int | None, _ROUNDS]
SimulationsOption = Annotated[int, _SIMULATIONS]
OptionalSimulationsOption = Annotated[int | None, _SIMULATIONS]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of everything random.")]
EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Effect to attach, port.effect or path/to/file.py:Class@port; repeat the option, or "
        "separate by commas.",
        autocompletion=complete_effect,
    ),
]
EmbeddingOption = Annotated[
    str,
    typer.Option(
        help="Trajectory features: score, all/50, gru/10, bayessim, ...",
        autocompletion=complete_embedding,
    ),
]
SegmentLengthOption = Annotated[
    str,
    typer.Option(
        help="Steps between re-synchronisations: a number, auto (0.2 s, or more where the motion "
        "is slow), or 0 for whole rollouts."
    ),
]
InitialStateOption = Annotated[InitialState, typer.Option(help="State at a segment's start.")]
PrecisionOption = Annotated[Precision, typer.Option(help="Floating-point type of the simulation.")]
NoiseOption = Annotated[
    Noise, typer.Option(help="Measurement noise: auto estimates it, model keeps the model's.")
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Refuse a recording with faults instead of repairing it.")
]
CommandsBeforeOption = Annotated[
    CommandsBefore,
    typer.Option(
        help="Commands before a rollout, for delays and lags: zero, the first ones, or auto."
    ),
]
DeviceOption = Annotated[str, typer.Option(help="Where to train: cpu or cuda.")]


def data_options(
    embedding: "str | Embedding | None",
    segment_length: str,
    initial_state: InitialState,
    precision: Precision,
    noise: Noise,
    strict: bool = False,
    commands_before: CommandsBefore = CommandsBefore.AUTO,
) -> "DataOptions":
    """Returns how a command prepares rollouts.

    Raises:
        DataError: ``segment_length`` is neither ``auto`` nor a number of steps.
    """
    from npdr_ppl.preparation.data_options import DataOptions

    return DataOptions(
        embedding,
        resolve_segment_length(segment_length),
        initial_state.value,
        precision.value,
        noise.value,
        strict,
        commands_before.value,
    )


def resolve_segment_length(word: str) -> "SegmentLength":
    """Returns the segment length that a word describes.

    Raises:
        DataError: It is neither ``auto`` nor a number of steps.
    """
    if word == "auto":
        return "auto"
    if not word.isdecimal():
        raise DataError(f"--segment-length is a number of steps, auto or 0; got {word!r}.")
    return int(word) or None
