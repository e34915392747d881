"""The errors of npdr_ppl: one small tree; each also inherits the fitting built-in error."""

__all__ = [
    "BackendError",
    "CompilationError",
    "DataError",
    "DependencyError",
    "IntractableError",
    "ModelError",
    "NpdrError",
    "ShapeError",
    "SimulationError",
    "TooShortError",
]


class NpdrError(Exception):
    """Base class of all errors that npdr_ppl raises on purpose; the message is one sentence."""


class DataError(NpdrError, ValueError):
    """Measured data are malformed or do not fit the model."""


class TooShortError(DataError):
    """Measured rollouts are valid and fit the model, but are too short for the task."""


class ModelError(NpdrError, ValueError):
    """A model, prior, simulator, port or effect is declared wrongly."""


class ShapeError(NpdrError, ValueError):
    """A tensor has a shape that does not fit."""


class IntractableError(NpdrError, NotImplementedError):
    """A density was requested that a black-box simulator does not have."""


class SimulationError(NpdrError, RuntimeError):
    """A simulator failed or returned something unusable."""


class BackendError(NpdrError, ValueError):
    """An inference backend is unknown, misconfigured or cannot handle the problem."""


class DependencyError(NpdrError, ImportError):
    """A required optional package is not installed."""


class CompilationError(NpdrError, RuntimeError):
    """The compiler failed on a time loop."""
