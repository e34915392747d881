"""The effects that a user has added by `npdr effects --add`."""

import functools
import logging
from dataclasses import dataclass
from pathlib import Path

from npdr_ppl.added_files import added_files
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect
from npdr_ppl.models.effects.effect_files import effects_of
from npdr_ppl.python_files import load_python_file

__all__ = ["AddedEffect", "added_effects"]

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class AddedEffect:
    """An effect that a user has added.

    Attributes:
        effect: Its class.
        file: The file in the folder of added effects that defines it.
    """

    effect: type[Effect]
    file: Path


def added_effects(reserved: frozenset[str] = frozenset()) -> dict[str, AddedEffect]:
    """Returns the effects that the user has added, by id, in the order of their files.

    A file that cannot be loaded is left out, and so is an effect whose id is taken. Each gets one
    warning.

    Args:
        reserved: Ids that are taken.
    """
    found: dict[str, AddedEffect] = {}
    for file in added_files():
        try:
            effects = effects_of(load_python_file(file), file)
        except (ModelError, OSError) as error:
            _warn_once(
                f"{error} The effect is left out; repair the file, or remove it with "
                f"`npdr effects --remove {file.name}`."
            )
            continue
        for effect in effects.values():
            if effect.id in reserved or effect.id in found:
                _warn_once(
                    f"{file} defines the effect {effect.id!r}, which there is already; it is left "
                    "out. Change the id in the file."
                )
            else:
                found[effect.id] = AddedEffect(effect, file)
    return found


@functools.cache
def _warn_once(message: str) -> None:
    _LOGGER.warning("%s", message)
