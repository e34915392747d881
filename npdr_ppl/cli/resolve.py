"""Turns command-line words into models, effects, data, targets, tasks and methods."""

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from npdr_ppl.cli.model_files import ROBOTS, derived_model, is_robot, load_function
from npdr_ppl.engines.common.robot_files import relative_to
from npdr_ppl.errors import BackendError, DataError, ModelError, NpdrError
from npdr_ppl.language.model import Model
from npdr_ppl.python_files import check_exists

if TYPE_CHECKING:
    from npdr_ppl.embeddings import Embedding
    from npdr_ppl.inference.base import Backend
    from npdr_ppl.language.simulator import Simulator
    from npdr_ppl.loop.control_task import ControlTask
    from npdr_ppl.policies.policy_search import PolicySearch
    from npdr_ppl.rollouts import Rollouts
    from npdr_ppl.rollouts.logs.matching import Column
    from npdr_ppl.targets.base import TargetDomain

__all__ = [
    "columns_of_model",
    "load_all",
    "resolve_backend",
    "resolve_device",
    "resolve_effects",
    "resolve_model",
    "resolve_rollouts",
    "resolve_search",
    "resolve_target",
    "resolve_task",
]

T = TypeVar("T")

DATA_FILES = (".csv", ".parquet", ".npz", ".nc")
"""File name extensions of rollouts."""

DEFAULT_TASKS = {"furuta": "furuta-swing-up", "furuta_paper": "furuta-swing-up"}
"""Default control task by name of the zoo's model."""


def resolve_model(word: str) -> Callable[..., Any]:
    """Returns the model that ``MODEL`` names.

    It is a zoo name, ``path/to/file.py:function``, or an MJCF or URDF file, from which a model is
    derived.

    Raises:
        ModelError: There is no such model.
    """
    from npdr_ppl.models import zoo

    entries = zoo()
    if word in entries:
        return entries[word].model
    if is_robot(word):
        return derived_model(Path(word))
    if not _is_function(word):
        close = get_close_matches(word, entries, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"the zoo has {', '.join(entries)}."
        path = Path(word)
        if path.suffix == ".py":
            hint = f"add the name of the model in it, as in {word}:model."
        elif Path(f"{word.partition(':')[0]}.py").is_file():
            hint = f"did you mean {word.partition(':')[0]}.py:{word.partition(':')[2] or 'model'}?"
        raise ModelError(
            f"{word!r} is neither a model of the zoo nor path/to/file.py:function nor a robot's "
            f"{' or '.join(ROBOTS)}; {hint}"
        )
    path, _, function = word.rpartition(":")
    return load_function(Path(path), function)


def columns_of_model(word: str) -> "list[Column]":
    """Returns the columns that the model that ``MODEL`` names reads from recordings.

    Raises:
        ModelError: There is no such model, or it has not one simulator.
    """
    from npdr_ppl.engines.mujoco import MujocoSimulator
    from npdr_ppl.language.only_simulator import only_simulator
    from npdr_ppl.rollouts.logs.matching import columns_of

    if is_robot(word):  # whose parameters do not matter here
        check_exists(Path(word), "*.*")
        simulator: Simulator = MujocoSimulator(Path(word))
    else:
        simulator = only_simulator(resolve_model(word))[0].simulator
    return columns_of(simulator.sensors, simulator.actions, simulator.followers)


def resolve_effects(model: Model, words: Sequence[str]) -> Callable[..., Any]:
    """Attaches effects given as ``port.effect``, or as ``path/to/file.py:Class@port``.

    A word may hold several effects, separated by commas.

    Raises:
        ModelError: There is no such effect.
    """
    from npdr_ppl.cli.effect_words import named_effects
    from npdr_ppl.language.handlers import add_effect

    for effect in named_effects(words):
        model = add_effect(model, effect)
    return model


def resolve_rollouts(
    paths: Sequence[Path],
    holdout: Sequence[str] | None = None,
    *,
    holdout_data: Path | None = None,
    mapping: Path | None = None,
) -> tuple[Any, Any]:
    """Loads rollouts, and held-out ones from the same files or from another.

    Args:
        paths: CSV, Parquet, NPZ, NetCDF, or logs of any format that a mapping describes.
        holdout: Positions of held-out rollouts over all files, e.g. ``["3,4"]``.
        holdout_data: Another file, all of whose rollouts are held out.
        mapping: Which signals of the logs are channels and actions.

    Returns:
        Rollouts to fit, and held-out rollouts or ``None``.

    Raises:
        DataError: A file is bad, files do not fit together, a position does not exist, or both
            kinds of held-out rollouts were given.
    """
    chosen = ",".join(holdout or ())
    if chosen and holdout_data is not None:
        raise DataError("--holdout and --holdout-data exclude each other; give one.")
    rollouts = load_all(paths, mapping)
    if holdout_data is not None:
        return rollouts, load_all([holdout_data], mapping)
    if not chosen:
        return rollouts, None
    told = paths[0] if len(paths) == 1 else f"all {len(paths)} files together"
    try:
        test = sorted({int(part) for part in chosen.split(",")})
    except ValueError:
        raise DataError(f"--holdout takes positions such as 3,4; got {chosen!r}.") from None
    if test[0] < 0 or test[-1] >= len(rollouts):
        raise DataError(
            f"--holdout {chosen} names rollouts that do not exist: {told} has "
            f"{len(rollouts)}, counted from 0, so the last is {len(rollouts) - 1}."
        )
    if len(test) == len(rollouts):
        raise DataError(
            f"--holdout {chosen} leaves no rollouts to fit: {told} has {len(rollouts)} in all."
        )
    train = [i for i in range(len(rollouts)) if i not in test]
    return rollouts[train], rollouts[test]


def load_all(paths: Sequence[Path], mapping: Path | None = None) -> "Rollouts":
    """Loads the rollouts of several files, one file after another.

    Args:
        paths: The files, at least one.
        mapping: Which signals of logs are channels and actions.

    Raises:
        DataError: A file is bad, or columns or time steps differ.
    """
    from npdr_ppl.rollouts import Rollouts

    return Rollouts.load(paths, mapping)


def resolve_device(word: str) -> str:
    """Returns the device that ``--device`` names, after checking that it is available.

    Raises:
        BackendError: There is no such device.
    """
    import torch

    try:
        torch.empty(0, device=word)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise BackendError(f"--device {word} is not available: {reason}; use cpu.") from error
    return word


def resolve_target(word: str) -> "TargetDomain":
    """Returns the target domain that ``TARGET`` names.

    The word is a target of the zoo, a file of recordings, ``gym:`` with the id of a Gymnasium
    environment, or ``path/to/file.py:function`` with a function that returns a target.

    Raises:
        DataError: The file is bad.
        ModelError: There is no such target.
    """
    from npdr_ppl.models import targets
    from npdr_ppl.models.furuta_targets import furuta_target
    from npdr_ppl.rollouts import Rollouts
    from npdr_ppl.targets import GymnasiumTarget, RecordedTarget, TargetDomain

    entries = targets()
    path = Path(word)
    if word in entries:
        return entries[word].make()
    if word.startswith("gym:"):
        return GymnasiumTarget(word.removeprefix("gym:"))
    if _is_function(word):
        return _returned_by(word, TargetDomain)
    if path.suffix.lower() in DATA_FILES:
        return RecordedTarget(Rollouts.load(path), name=path.stem)
    if word.startswith("furuta-"):
        return furuta_target(word)
    close = get_close_matches(word, entries, n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"the zoo has {', '.join(entries)}."
    raise ModelError(
        f"{word!r} is neither a target of the zoo nor a data file, gym:ENVIRONMENT or "
        f"path/to/file.py:function; {hint}"
    )


def resolve_task(word: str, model: str) -> "ControlTask":
    """Returns the task that ``--task`` names: one of the zoo, or ``path/to/file.py:function``.

    Args:
        word: The task; empty for the model's default task.
        model: The word that named the model.

    Raises:
        ModelError: There is no such task, or the model has no default task.
    """
    from npdr_ppl.loop.control_task import ControlTask, control_task, control_tasks

    if _is_function(word):
        return _returned_by(word, ControlTask)
    word = word or DEFAULT_TASKS.get(model, "")
    if not word:
        raise ModelError(
            f"There is no task that goes with {model}: pass --task with path/to/file.py:function "
            f"or one of {', '.join(control_tasks())}."
        )
    return control_task(word)


def resolve_backend(word: str, embedding: str) -> "tuple[str | Backend, str | Embedding | None]":
    """Returns the backend that e.g. ``snpe-c(flow=maf)`` names, and its features.

    A backend without options is returned as the word itself, which is recorded with the run.

    Args:
        word: The value of ``--backend``.
        embedding: The value of ``--embedding``; it counts unless the backend has features of its
            own, as in ``snpe-c(embedding=gru/10)``.

    Raises:
        BackendError: There is no such backend or option.
    """
    from npdr_ppl.posterior.comparison.compared_backends import candidate

    found = candidate(word)
    method = found.backend if "(" in word else found.backend.name
    return method, found.embedding or embedding


def resolve_search(word: str) -> "str | PolicySearch[Any]":
    """Returns the policy search that e.g. ``power`` or ``power(population=100)`` names.

    Without options it returns the word itself, which is recorded with the run.

    Raises:
        ModelError: There is no such search or option.
    """
    from npdr_ppl.policies.search_registry import policy_search
    from npdr_ppl.posterior.comparison.compared_backends import name_and_options

    name, options = name_and_options(word)
    try:
        search = policy_search(name, **options)
    except TypeError as error:
        raise ModelError(f"{word!r} has an option of the wrong type: {error}.") from error
    return search if options else name


def _is_function(word: str) -> bool:
    """Returns whether a word has the form ``path/to/file.py:function``."""
    path, separator, _ = word.rpartition(":")
    return bool(separator) and path.endswith(".py")


def _returned_by(word: str, kind: type[T]) -> T:
    """Calls the function that ``path/to/file.py:function`` names, and checks what it returns."""
    path, _, function = word.rpartition(":")
    try:
        make = load_function(Path(path), function)
        with relative_to(Path(path).parent):
            found = make()
    except NpdrError:
        raise
    except Exception as error:
        raise ModelError(f"{word} failed: {type(error).__name__}: {error}.") from error
    if not isinstance(found, kind):
        raise ModelError(
            f"{word} should return a {kind.__name__}; it returned a {type(found).__name__}."
        )
    return found
