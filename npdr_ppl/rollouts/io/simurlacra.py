"""Imports rollouts recorded with SimuRLacra, without running code from their pickles."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.collection import joined
from npdr_ppl.rollouts.io.inert_pickle import Record, read_pickle
from npdr_ppl.rollouts.recording import Recording

__all__ = ["read_simurlacra"]

_ROLLOUT = "pyrado.sampling.step_sequence StepSequence"
_SPECIFICATION = "pyrado.utils.data_types EnvSpec"
_BOX = "pyrado.spaces.box BoxSpace"


def read_simurlacra(
    path: str | PathLike[str], names: Mapping[str, str] | None = None
) -> Recording:
    """Reads rollouts; see :meth:`Rollouts.from_simurlacra`."""
    path = rollout_checks.check_file(path)
    with rollout_checks.named(path):
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot be read ({error.strerror}).") from None
        content = read_pickle(data, (_ROLLOUT, _SPECIFICATION, _BOX))
        episodes = content if isinstance(content, list) else [content]
        if not episodes or not all(_is(episode, _ROLLOUT) for episode in episodes):
            raise DataError("the pickle holds no SimuRLacra rollout.")
        if len(episodes) > LIMITS.rollouts:
            raise DataError(f"it has {len(episodes)} rollouts, more than {LIMITS.rollouts}.")
        # The same array may occur many times, and numbers of fewer bytes become float64.
        check_expansion(8.0 * sum(_numbers(episode.fields) for episode in episodes), len(data))
        episodes = [_episode(episode.fields, names or {}) for episode in episodes]
        # Consecutive rollouts with the same columns are checked together: three times as fast.
        alike = itertools.groupby(episodes, key=lambda e: (e.columns, e.rewards is None))
        return joined([_recording(list(group)) for _, group in alike])


@dataclass(frozen=True)
class _Episode:
    """One rollout, as it is in the pickle.

    Attributes:
        columns: Names of the channels and of the actions.
        readings: Measurements, ``(T + 1, channels)``.
        actions: Actions, ``(T, actions)``.
        rewards: Rewards, ``(T,)``, or ``None``.
        time: Time stamps in s, ``(T + 1,)``.
    """

    columns: tuple[tuple[str, ...], tuple[str, ...]]
    readings: NDArray[np.float64]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64] | None
    time: NDArray[np.float64]


def _numbers(fields: Mapping[str, Any]) -> int:
    return sum(values.size for values in fields.values() if isinstance(values, np.ndarray))


def _episode(fields: Mapping[str, Any], names: Mapping[str, str]) -> _Episode:
    bounds = fields.get("_rollout_bounds")
    if isinstance(bounds, np.ndarray) and bounds.size > 2:
        raise DataError("the rollouts are joined end to end; save them as a list instead.")
    spaces = _spaces(fields)
    kind = "states" if "states" in fields else "observations"
    readings = _matrix(fields, kind)
    actions = _matrix(fields, "actions_applied" if "actions_applied" in fields else "actions")
    channels = _labels(spaces.get(kind), readings.shape[1], kind.removesuffix("s"))
    commands = _labels(spaces.get("actions"), actions.shape[1], "action")
    return _Episode(
        (
            tuple(names.get(name, name) for name in channels),
            tuple(names.get(name, name) for name in commands),
        ),
        readings,
        actions,
        _matrix(fields, "rewards")[:, 0] if "rewards" in fields else None,
        _matrix(fields, "time")[:, 0],
    )


def _recording(episodes: Sequence[_Episode]) -> Recording:
    """Returns rollouts with the same columns as one recording."""
    channels, actions = episodes[0].columns
    rewards = [e.rewards for e in episodes if e.rewards is not None]
    return Recording.from_arrays(
        [e.readings for e in episodes],
        [e.actions for e in episodes],
        channel_names=channels,
        action_names=actions,
        rewards=rewards or None,
        time=[e.time for e in episodes],
    )


def _spaces(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the declared spaces, which contain the column names."""
    info = fields.get("rollout_info")
    specification = info.get("env_spec") if isinstance(info, dict) else None
    if not _is(specification, _SPECIFICATION):
        return {}
    return dict(zip(("observations", "actions", "states"), specification.arguments, strict=False))


def _labels(space: Any, count: int, fallback: str) -> Sequence[str]:
    labels = space.fields.get("_labels") if _is(space, _BOX) else None
    if isinstance(labels, np.ndarray) and labels.shape == (count,) and labels.dtype.kind == "U":
        return [str(label) for label in labels]
    return [f"{fallback}_{index}" for index in range(count)]


def _matrix(fields: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Returns a field as float64 ``(rows, columns)``."""
    values = fields.get(name)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise DataError(f"the rollout has no numbers called {name}.")
    if values.ndim not in (1, 2):
        raise DataError(f"{name} has {values.ndim} dimensions.")
    return values.astype(np.float64).reshape(len(values), -1)


def _is(value: Any, kind: str) -> TypeGuard[Record]:
    return isinstance(value, Record) and value.kind == kind
