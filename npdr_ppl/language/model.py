"""What counts as a model: any callable that Pyro can run."""

from typing import Any, Protocol

__all__ = ["Model"]


class Model(Protocol):
    """A Pyro program with at least one black-box site.

    Called with one :class:`~npdr_ppl.language.inputs.Inputs` for each site that has inputs. It may
    be a function or a callable object, and may be wrapped in handlers.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the program once."""
        ...
