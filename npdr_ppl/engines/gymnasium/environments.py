"""Creates Gymnasium environments and converts their box spaces to channels."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from npdr_ppl.errors import DependencyError, ModelError
from npdr_ppl.language.channels import Channel

__all__ = ["box_channels", "limited_channels", "load_gymnasium", "make_environment"]


def load_gymnasium() -> Any:
    """Returns the package.

    Raises:
        DependencyError: It is not installed.
    """
    try:
        return importlib.import_module("gymnasium")
    except ImportError as error:
        raise DependencyError(
            "Environments need Gymnasium: pip install npdr-ppl[gymnasium]."
        ) from error


def make_environment(name: str, specification: Any = None, *, is_checked: bool = True) -> Any:
    """Returns a new environment.

    Args:
        name: Its id, e.g. ``"Pendulum-v1"``.
        specification: Its ``EnvSpec``, with which it is made also where its id is not registered.
        is_checked: Whether Gymnasium checks that the environment's steps follow its interface.

    Raises:
        ModelError: There is no such environment, or a package that it needs is not installed.
    """
    gymnasium = load_gymnasium()
    try:
        return gymnasium.make(specification or name, disable_env_checker=not is_checked)
    except (gymnasium.error.Error, ImportError) as error:
        raise ModelError(f"Gymnasium cannot make {name!r}: {error}") from error


def box_channels(space: Any, prefix: str) -> tuple[Channel, ...]:
    """Returns a channel without a unit for each entry of a box, ``<prefix>_0`` and so on."""
    low = np.array(space.low, dtype=np.float64).reshape(-1)
    high = np.array(space.high, dtype=np.float64).reshape(-1)
    return tuple(
        Channel(f"{prefix}_{index}", "", float(lower), float(upper))
        for index, (lower, upper) in enumerate(zip(low, high, strict=True))
    )


def limited_channels(
    space: Any, actions: Sequence[Channel] | None, name: str
) -> tuple[Channel, ...]:
    """Returns action channels with the limits of an environment's box.

    Args:
        space: The box.
        actions: Their names and units; ``None`` for ``action_0`` and so on.
        name: The environment's name, for messages.

    Raises:
        ModelError: The box has a different number of entries.
    """
    own = box_channels(space, "action")
    if actions is None:
        return own
    if len(actions) != len(own):
        raise ModelError(f"{name} has {len(own)} actions, but {len(actions)} were named.")
    return tuple(
        Channel(named.name, named.unit, limit.lower, limit.upper, named.rate_of)
        for named, limit in zip(actions, own, strict=True)
    )
