"""A run of the NPDR loop as a folder: JSON, safetensors and NetCDF; nothing is ever unpickled.

    loop.json                         what is run: model, target, task, options, seed, versions
    rollouts/rollout_<n>.nc           real rollouts, each with its journal ``.jsonl``
    excitation_<n>.json               the excitation of a further rollout, and how it was chosen
    policy_<k>.safetensors, .json     the result of POLOPT number k; 0 is trained on the prior
    inference_<i>_<attempt>/          runs of inference, see :mod:`npdr_ppl.posterior.run_folder`
    policy_<k>_<d>.safetensors, .json drafts of policy k: before another rollout, for the mean or
                                      for the tail; the last or the better one becomes policy k
    revision_<i>/, revision_<i>_<l>/  result of discovery: revised_model.py, then discovery.json;
                                      search l of an iteration follows a rollout that a check of
                                      the new policy asked for
    iteration_<i>.json                the record of a finished iteration
    train.json                        the result so far

Each file is replaced in one atomic step. If a run is killed at any moment, :func:`npdr_ppl.train`
can continue from the folder.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.language.model import Model
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.model_code import code_checksum
from npdr_ppl.model_identity import model_name, source_text, versions
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.run_files import (
    holds_this_run,
    load_tensors,
    make_folder,
    plain,
    read_json,
    save_tensors,
    write_json,
)
from npdr_ppl.run_records import ExcitationRecord, IterationRecord, PolicyRecord
from npdr_ppl.targets.base import TargetDomain

if TYPE_CHECKING:
    from npdr_ppl.loop.loop_options import LoopOptions

__all__ = ["LoopFolder"]

FORMAT = 1


class LoopFolder:
    """Reads and writes the folder of one run of the loop.

    Args:
        path: The folder; it is made if absent.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(
        self,
        model: Model,
        target: TargetDomain,
        task: ControlTask,
        options: DataOptions,
        loop: "LoopOptions",
        *,
        seed: int,
    ) -> None:
        """Writes the run's description, or checks that the folder contains this same run.

        Raises:
            DataError: The folder contains a run with another model, target or options.
        """
        make_folder(self.path)
        description = plain(
            {
                "format": FORMAT,
                "name": model_name(model),
                "code": code_checksum(model),
                "target": repr(target),
                "task": task.name,
                "num_steps": task.num_steps,
                "binding": repr(options),
                "options": _words(loop),
                "seed": seed,
            }
        )
        # A run may be continued with more iterations.
        iterations = description["options"].pop("iterations")
        file = self.path / "loop.json"
        if not holds_this_run(file, description):
            written = {"iterations": iterations, "versions": versions()}
            write_json(file, description | written | {"model": source_text(model)})

    @property
    def rollouts(self) -> Path:
        """Folder of the real rollouts."""
        return self.path / "rollouts"

    def inference(self, index: int, attempt: int) -> Path:
        """Returns the folder of a run of inference."""
        return self.path / f"inference_{index}_{attempt}"

    def revision(self, index: int, look: int = 0) -> Path:
        """Returns the folder of a search for missing effects in an iteration."""
        return self.path / f"revision_{_numbered(index, look or None)}"

    def save_policy(
        self,
        number: int,
        parameters: Tensor,
        figures: Mapping[str, Any],
        *,
        draft: int | None = None,
    ) -> None:
        """Saves a trained policy, or a draft; it counts as saved once the JSON exists."""
        file = self.path / f"policy_{_numbered(number, draft)}.json"
        save_tensors(file.with_suffix(".safetensors"), {"parameters": parameters})
        write_json(file, figures)

    def policy(
        self, number: int, draft: int | None = None
    ) -> tuple[Tensor, dict[str, Any]] | None:
        """Returns parameters and figures of a policy, ``None`` if it is not trained yet."""
        file = self.path / f"policy_{_numbered(number, draft)}.json"
        if not file.exists():
            return None
        tensors = load_tensors(file.with_suffix(".safetensors"), "parameters")
        figures = read_json(file, PolicyRecord)
        if draft is not None and "check" not in figures:
            raise DataError(f"{file} lacks the check of the policy.")
        return tensors["parameters"], dict(figures)

    def save_excitation(self, episode: int, excitation: Mapping[str, Any]) -> None:
        """Saves the excitation of an episode, after its rollout."""
        write_json(self.path / f"excitation_{episode:03d}.json", excitation)

    def excitation(self, episode: int) -> dict[str, Any] | None:
        """Returns the excitation of an episode, ``None`` if none is saved."""
        file = self.path / f"excitation_{episode:03d}.json"
        return dict(read_json(file, ExcitationRecord)) if file.exists() else None

    def save_iteration(self, index: int, record: Mapping[str, Any]) -> None:
        """Saves the record of a finished iteration."""
        write_json(self.path / f"iteration_{index}.json", record)

    def iteration(self, index: int) -> dict[str, Any] | None:
        """Returns the record of an iteration, ``None`` if it is not finished."""
        file = self.path / f"iteration_{index}.json"
        if not file.exists():
            return None
        record = read_json(file, IterationRecord)
        if not record["decisions"] or not all("action" in d for d in record["decisions"]):
            raise DataError(f"{file} lacks the actions after its decisions.")
        return dict(record)

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Writes ``train.json``."""
        write_json(self.path / "train.json", result)


def _numbered(number: int, part: int | None) -> str:
    return f"{number}" if part is None else f"{number}_{part}"


def _words(options: "LoopOptions") -> dict[str, Any]:
    """Returns the options as JSON-serialisable values; other objects as their ``repr``."""
    result = {}
    for item in dataclasses.fields(options):
        value = getattr(options, item.name)
        result[item.name] = value if isinstance(value, int | float | str | None) else repr(value)
    return result
