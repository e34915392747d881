"""An inference run as a folder: JSON, safetensors and NetCDF; no pickle is written or read.

    run.json                      backend, options, seeds, versions, the model's source,
                                  engines with their settings and the text of MJCF and URDF files
    data_<site>.nc                measured rollouts (or data.safetensors for plain observations)
    preparation.json, .safetensors      noise, initial states and features made for the recording
    checks.json, correction.safetensors what is known of estimator and model, and what took the
                                        place of the learnt posterior where it was off
    round_<r>_simulations.safetensors   parameters z and features x of a round
    round_<r>.safetensors, round_<r>.json   the backend's state after that round

Beside it, ``asked.json`` has what a fit was asked for: another fit is refused at once.

Every file replaces its predecessor in one step, so a run killed at any moment leaves a folder that
:func:`npdr_ppl.infer` continues from.
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.embeddings.score import Score
from npdr_ppl.errors import DataError
from npdr_ppl.inference.base import Backend, RoundInfo
from npdr_ppl.language.handlers import (
    num_finer_steps,
    with_finer_steps,
    with_noise,
)
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.model_code import code_checksum
from npdr_ppl.model_identity import engine_settings, model_name, source_text, versions
from npdr_ppl.posterior.estimator_check import Correction
from npdr_ppl.posterior.prepare import Preparation
from npdr_ppl.preparation.binding import BoundModel
from npdr_ppl.preparation.data_options import DataOptions, checked_options
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import checksum
from npdr_ppl.run_files import (
    holds_this_run,
    load_tensors,
    make_folder,
    read_json,
    reading_back,
    save_tensors,
    write_json,
)
from npdr_ppl.run_records import PreparationRecord, RoundRecord, RunDescription

__all__ = ["ASKED", "RUN", "RunFolder", "SavedPreparation", "SavedRound", "begin_fit"]

ASKED, RUN = "asked.json", "run"
"""Names, in the folder of a fit, of the file with what was asked for, and of the run's folder."""

FORMAT = 1

SKETCHED = 4
"""Number of random projections by which features are recognised."""

MAX_FINER_STEPS = 20
"""Largest number of times that integration steps are halved; the search stops long before."""


@dataclasses.dataclass(frozen=True)
class SavedRound:
    """A backend's state after a round, and the figures of all rounds up to it."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]
    infos: list[RoundInfo]
    seconds: dict[str, float]


@dataclasses.dataclass(frozen=True)
class SavedPreparation:
    """The preparation of a recording before inference.

    Attributes:
        starts: The segments' estimated initial states.
        score: The score features, if they were made for the recording.
        noise: Estimated noise by sensor; ``None`` if the model kept its own.
        num_finer_steps: Number of times that the model's integration steps were refined in all.
    """

    starts: InitialStates | None = None
    score: Score | None = None
    noise: Mapping[str, float] | None = None
    num_finer_steps: int = 0

    def apply(self, model: Any) -> Any:
        """Returns a model with the noise and steps with which the posterior was inferred."""
        # The model's own finer steps are counted, too.
        for _ in range(self.num_finer_steps - num_finer_steps(model)):
            model = with_finer_steps(model)
        return model if self.noise is None else with_noise(model, self.noise)


class RunFolder:
    """Reads and writes the folder of one inference run.

    Args:
        path: The folder; it is made if absent.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(
        self, bound: BoundModel, method: Backend, *, seed: int, rounds: int, num_simulations: int
    ) -> None:
        """Describes the run, or checks that the folder holds this very run already.

        Raises:
            DataError: The folder holds a run with other settings or data.
        """
        make_folder(self.path)
        description = {
            "format": FORMAT,
            **_asked(bound.model, method, bound.options, seed, num_simulations),
            "fingerprint": _fingerprint(bound.data),
            "features": _sketch(bound.observed_features()),
        }
        file = self.path / "run.json"
        if holds_this_run(file, description):
            return
        for name, data in bound.data.items():
            if isinstance(data, Rollouts):
                data.to_netcdf(self.path / f"data_{name}.nc")
            else:
                file_name = f"data_{name}.safetensors"
                save_tensors(self.path / file_name, {"value": torch.as_tensor(data)})
        write_json(
            file,
            description
            | {
                "rounds": rounds,
                "versions": versions(),
                "model": {"name": model_name(bound.model), "source": source_text(bound.model)},
                "engines": engine_settings(bound.prior),
            },
        )

    def save_preparation(self, found: Preparation) -> None:
        """Saves the preparation of the recording before inference."""
        tensors = {}
        if found.starts is not None:
            for field in dataclasses.fields(found.starts):
                tensors[f"starts_{field.name}"] = getattr(found.starts, field.name)
        if isinstance(found.options.embedding, Score):
            for field in dataclasses.fields(Score):
                tensors[f"score_{field.name}"] = getattr(found.options.embedding, field.name)
        save_tensors(self.path / "preparation.safetensors", tensors)
        write_json(
            self.path / "preparation.json",
            {
                "noise": found.noise_of_sensors,
                "num_finer_steps": num_finer_steps(found.plain_model),
            },
        )

    def preparation(self) -> "SavedPreparation":
        """Returns the saved preparation; an empty one if none was saved."""
        file = self.path / "preparation.json"
        if not file.exists():
            return SavedPreparation()
        record = read_json(file, PreparationRecord)
        tensors = load_tensors(self.path / "preparation.safetensors")
        if not 0 <= record["num_finer_steps"] <= MAX_FINER_STEPS:
            raise DataError(f"{file} has an impossible number of finer steps.")

        def part(prefix: str) -> dict[str, Tensor]:
            chosen = {k: v for k, v in tensors.items() if k.startswith(prefix)}
            return {name.removeprefix(prefix): value for name, value in chosen.items()}

        starts, score = part("starts_"), part("score_")
        with reading_back(file):
            return SavedPreparation(
                InitialStates(**starts) if starts else None,
                Score(**score) if score else None,
                record["noise"],
                record["num_finer_steps"],
            )

    def save_correction(self, correction: Correction | None, checks: Mapping[str, Any]) -> None:
        """Saves the posterior that replaces the learnt one, if any, and the checks."""
        file = self.path / "correction.safetensors"
        if correction is not None:
            save_tensors(file, correction.tensors())
        write_json(self.path / "checks.json", {"is_corrected": correction is not None, **checks})

    def correction(self, prior: Prior) -> tuple[Correction | None, dict[str, Any]]:
        """Returns what :meth:`save_correction` wrote; nothing if it was never called."""
        from npdr_ppl.posterior.estimator_check import Correction

        file = self.path / "checks.json"
        if not file.exists():
            return None, {}
        checks = read_json(file)
        if not checks.pop("is_corrected", False):
            return None, checks
        tensors = load_tensors(self.path / "correction.safetensors")
        with reading_back(file):
            return Correction.of_tensors(prior, tensors), checks

    def rounds(self) -> list[int]:
        """Returns the complete rounds, in order."""
        names = (file.stem.removeprefix("round_") for file in self.path.glob("round_*.json"))
        return sorted(int(name) for name in names if name.isdecimal() and len(name) < 10)

    def load_round(self, index: int) -> "SavedRound":
        """Returns what :meth:`save_round` wrote after a round."""
        stem = self.path / f"round_{index}"
        record = read_json(stem.with_suffix(".json"), RoundRecord)
        with reading_back(stem.with_suffix(".json")):
            infos = [RoundInfo(**info) for info in record["infos"]]
        tensors = load_tensors(stem.with_suffix(".safetensors"))
        return SavedRound(tensors, record["values"], infos, record["seconds"])

    def save_round(
        self,
        index: int,
        tensors: Mapping[str, Tensor],
        values: Mapping[str, Any],
        infos: Sequence[RoundInfo],
        seconds: Mapping[str, float],
    ) -> None:
        """Saves the state after a round; the JSON goes last and makes the round count."""
        save_tensors(self.path / f"round_{index}.safetensors", tensors)
        write_json(
            self.path / f"round_{index}.json",
            {
                "values": dict(values),
                "infos": [dataclasses.asdict(info) for info in infos],
                "seconds": dict(seconds),
            },
        )

    def save_simulations(self, index: int, z: Tensor, x: Tensor) -> None:
        """Saves a round's simulations before anything is learnt from them."""
        save_tensors(self._simulations(index), {"z": z, "x": x})

    def simulations(self, index: int, z: Tensor) -> Tensor | None:
        """Returns the features of a round simulated before the run was interrupted."""
        file = self._simulations(index)
        if not file.exists():
            return None
        saved = load_tensors(file, "z", "x")
        is_same = saved["z"].shape == z.shape and torch.allclose(saved["z"], z.cpu(), 1e-6, 1e-6)
        return saved["x"] if is_same else None

    def description(self) -> RunDescription:
        """Returns what :meth:`begin` wrote.

        Raises:
            DataError: The folder holds no run.
        """
        file = self.path / "run.json"
        if not file.exists():
            raise DataError(f"{self.path} holds no inference run (run.json is missing).")
        return read_json(file, RunDescription)

    def data(self) -> dict[str, Rollouts | Tensor]:
        """Returns the measured data by site."""
        result: dict[str, Rollouts | Tensor] = {}
        for file in sorted(self.path.glob("data_*")):
            name = file.stem.removeprefix("data_")
            if file.suffix == ".nc":
                result[name] = Rollouts.from_netcdf(file)
            else:
                result[name] = load_tensors(file, "value")["value"]
        return result

    def _simulations(self, index: int) -> Path:
        return self.path / f"round_{index}_simulations.safetensors"


def begin_fit(
    path: Path,
    model: Model,
    rollouts: Rollouts,
    method: Backend,
    options: DataOptions | None,
    seed: int,
    num_simulations: int,
) -> None:
    """Writes what a fit is asked for, or checks that the run in its folder is asked for the same.

    :meth:`RunFolder.begin` can check only after the preparation, which may take most of the time.
    A folder without a run is free for any fit; one of an earlier version is left to that check.

    Raises:
        DataError: The folder holds a run with other settings or data.
    """
    description = {
        **_asked(model, method, checked_options(options), seed, num_simulations),
        "fingerprint": _fingerprint({"rollouts": rollouts}),
    }
    if not (path / RUN / "run.json").exists():
        write_json(path / ASKED, description)
    elif (path / ASKED).exists():
        holds_this_run(path / ASKED, description)


def _asked(
    model: Model, method: Backend, options: DataOptions, seed: int, num_simulations: int
) -> dict[str, Any]:
    return {
        "backend": method.name,
        "options": dataclasses.asdict(method) if dataclasses.is_dataclass(method) else {},
        "binding": _binding(options),
        "seed": seed,
        "num_simulations": num_simulations,
        "code": code_checksum(model),
    }


def _binding(options: DataOptions) -> dict[str, Any]:
    values = dataclasses.asdict(options)
    embedding = options.embedding
    values["embedding"] = embedding if isinstance(embedding, str | None) else repr(embedding)
    return values


def _fingerprint(data: Mapping[str, Rollouts | Tensor]) -> str:
    """Returns a SHA-256 of all measured data."""
    digest = hashlib.sha256()
    for name, value in sorted(data.items()):
        digest.update(name.encode())
        if isinstance(value, Rollouts):
            digest.update(checksum(value).encode())
        else:
            values = torch.as_tensor(value).detach().cpu().double().contiguous()
            digest.update(values.numpy().tobytes())
    return digest.hexdigest()


def _sketch(features: Tensor) -> list[float]:
    """Returns projections of features on random directions, by which others are recognised.

    Features can be derived from a fit, so they are compared up to rounding, not by a checksum.
    """
    flat = features.detach().cpu().double().flatten()
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(SKETCHED, len(flat), generator=generator, dtype=torch.float64)
    return (directions @ flat / math.sqrt(len(flat))).tolist()
