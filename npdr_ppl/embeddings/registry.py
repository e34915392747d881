"""Embeddings by name."""

import re
from collections.abc import Callable
from difflib import get_close_matches

from npdr_ppl.embeddings.base import Embedding
from npdr_ppl.embeddings.networks import Convolutional, Linear, Recurrent
from npdr_ppl.embeddings.statistics import AllSteps, BayesSimStatistic, Differences, LastStep
from npdr_ppl.embeddings.wrappers import Averaged, Masked, Strided
from npdr_ppl.errors import ModelError

__all__ = ["embedding_by_name"]

_EMBEDDINGS: dict[str, Callable[[], Embedding]] = {
    "bayessim": BayesSimStatistic,
    "last": LastStep,
    "all": AllSteps,
    "differences": Differences,
    "gru": Recurrent,
    "conv": Convolutional,
    "linear": Linear,
}

_WORD = re.compile(
    r"(?P<name>[a-z]+)"
    r"(\[(?P<channels>[^\[\]]+)\])?((?P<thinning>[/~])(?P<step>[1-9][0-9]{0,6}))?"
)


def embedding_by_name(word: str) -> Embedding:
    """Returns the embedding that a word describes: ``name[channel,channel]/stride``.

    Args:
        word: A name, optionally with the channels to embed, and a
            stride in steps after ``/`` or the length of blocks to average after ``~``, e.g.
            ``"bayessim"``, ``"all/10"``, ``"all~10"`` or ``"all[ball_x,ball_y]/2"``.

    Raises:
        ModelError: There is no such embedding.

    Example:
        >>> embedding_by_name("all/10")
        Strided(inner=AllSteps(), stride=10)
    """
    match = _WORD.fullmatch(word)
    if match is None or match["name"] not in _EMBEDDINGS:
        close = get_close_matches(match["name"] if match else word, _EMBEDDINGS, n=1)
        raise ModelError(
            f"there is no embedding {word!r}; {f'did you mean {close[0]!r}? ' if close else ''}"
            f"{'Write' if close else 'write'} one of {', '.join(_EMBEDDINGS)}, with a "
            "stride as in all/10, means of blocks as in all~10, or channels as in all[x,y]/10."
        )
    result = _EMBEDDINGS[match["name"]]()
    if match["channels"] is not None:
        result = Masked(result, tuple(part.strip() for part in match["channels"].split(",")))
    if match["thinning"] == "/":
        result = Strided(result, int(match["step"]))
    elif match["thinning"] == "~":
        result = Averaged(result, int(match["step"]))
    return result
