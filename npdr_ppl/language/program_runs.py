"""Runs of a program that are invisible to outer handlers."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch.distributions import Distribution

from npdr_ppl.errors import ModelError, NpdrError
from npdr_ppl.language.model import Model

__all__ = ["BATCH_PLATE", "alone", "sample_sites", "traced", "unvalidated"]

BATCH_PLATE = "_npdr_batch"
"""Name of the plate to the left of a program's plates; it evaluates all points in one run."""

ALL_POINTS = (
    "A program runs at many points at once, whose dimension comes first: index from the right, a "
    "vector's component as mass[..., 0], a member of a plate as mass[..., :1]."
)
"""Advice for a program that uses the dimension of the points as one of its own."""


@contextmanager
def alone() -> Iterator[None]:
    """Hides a run of the program from outer handlers and switches off validation."""
    with unvalidated(), poutine.block():
        yield


@contextmanager
def unvalidated() -> Iterator[None]:
    """Switches off the validation of distributions' arguments and values.

    Values are not validated, because some are deliberately off their support, and a NaN from one
    simulation must not affect the others. Pyro's own switch is not enough, because other libraries
    change torch's default without Pyro's knowledge.
    """
    is_validating = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(is_validating)


def traced(model: Model, args: tuple[Any, ...]) -> Any:
    """Traces a run of the program; our own errors are raised without Pyro's table of shapes.

    Raises:
        ModelError: A site does not fit its plates, or plates do not fit each other.
    """
    try:
        return poutine.trace(model).get_trace(*args)
    except ValueError as error:
        if isinstance(error, NpdrError):
            raise _innermost(error) from None
        sentence = _about_plates(str(error))
        if sentence is None:
            raise
        raise ModelError(sentence) from error
    except NpdrError as error:
        raise _innermost(error) from None


def _innermost(error: NpdrError) -> NpdrError:
    while isinstance(error.__cause__, NpdrError):
        error = error.__cause__
    return error


def _about_plates(message: str) -> str | None:
    """Returns Pyro's message about plates as a sentence; ``None`` for other messages."""
    found = re.match(
        r"Shape mismatch inside plate\('(.*?)'\) at site (\S+) dim (-\d+), (\d+) vs (\d+)", message
    )
    if found is not None:
        plate, site, dim, size, came = found.groups()
        if plate == BATCH_PLATE:
            return f"Site {site!r} has {came} values in the dimension of the points. {ALL_POINTS}"
        return (
            f"Site {site!r} has {came} values in dimension {dim}, where the plate {plate!r} has "
            f"{size}; give the site the plate's size there, or one value that all share."
        )
    found = re.match(r'at plates "(.*?)" and "(.*?)", collide at dim=(-\d+)', message)
    if found is not None:
        first, second, dim = found.groups()
        return (
            f"The plates {first!r} and {second!r} both take dimension {dim}; give one of them "
            f"another, e.g. dim={int(dim) - 1}."
        )
    return None


def sample_sites(trace: Any) -> list[tuple[str, Any]]:
    """Returns name and message of every sample site of a trace, except subsampling sites."""
    return [
        (name, site)
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site_is_subsample(site)
    ]
