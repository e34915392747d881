"""Runs of a program that nothing outside notices."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch.distributions import Distribution

from npdr_ppl.errors import NpdrError

__all__ = ["alone", "sample_sites", "traced"]


@contextmanager
def alone() -> Iterator[None]:
    """Keeps a run of the program to itself: outside handlers do not see it.

    Values are not validated: those off a support are asked about on purpose, and a simulation that
    gave NaN costs only itself. Pyro's own switch would not do, because other libraries change
    torch's default behind its back.
    """
    is_validating = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        with poutine.block():
            yield
    finally:
        Distribution.set_default_validate_args(is_validating)


def traced(model: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Traces a run of the program; our own errors come out without Pyro's table of shapes."""
    try:
        return poutine.trace(model).get_trace(*args)
    except NpdrError as error:
        while isinstance(error.__cause__, NpdrError):
            error = error.__cause__
        raise error from None


def sample_sites(trace: Any) -> list[tuple[str, Any]]:
    """Returns name and message of every sample site of a trace, without those of subsampling."""
    return [
        (name, site)
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site_is_subsample(site)
    ]
