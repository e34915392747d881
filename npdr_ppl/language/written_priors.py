"""Priors of single numbers as a name and arguments, so that files can keep them."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import pyro.distributions
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.errors import DataError

__all__ = ["read_prior", "written_prior"]

_NAME = "distribution"


def written_prior(prior: Distribution) -> dict[str, Any] | None:
    """Returns a prior's name in Pyro, under ``"distribution"``, and its arguments.

    ``None`` if it is none of Pyro's own distributions, or not of one number with numbers as
    arguments, or cannot be made again from these.
    """
    name = type(prior).__name__
    if getattr(pyro.distributions, name, None) is not type(prior):
        return None
    written: dict[str, Any] = {_NAME: name}
    for word in inspect.signature(type(prior)).parameters:
        value = getattr(prior, word, None)
        if isinstance(value, Tensor) and value.ndim == 0:
            written[word] = value.item()
        elif word != "validate_args":
            return None
    try:
        read_prior(written)
    except DataError:
        return None
    return written


def read_prior(written: Mapping[str, Any]) -> Distribution:
    """Returns the prior that :func:`written_prior` wrote.

    Raises:
        DataError: It is no such prior.
    """
    arguments = {word: value for word, value in written.items() if word != _NAME}
    found = getattr(pyro.distributions, str(written.get(_NAME)), None)
    try:
        if not (inspect.isclass(found) and issubclass(found, Distribution)):
            raise ValueError(f"no distribution {written.get(_NAME)!r}")
        make = cast(Callable[..., Distribution], found)
        numbers = {word: float(value) for word, value in arguments.items()}
        prior = make(**numbers, validate_args=True)
        if prior.batch_shape or prior.event_shape:
            raise ValueError("several numbers")
        return prior
    except (TypeError, ValueError, AttributeError, NotImplementedError) as error:
        raise DataError(f"{dict(written)} is no prior of one number: {error}") from error
