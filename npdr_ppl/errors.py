"""The errors of npdr_ppl: one small tree, each also the built-in it resembles."""

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
    """Root of every error raised on purpose; its message is one sentence for a person."""


class DataError(NpdrError, ValueError):
    """Measured data are malformed or do not fit the model."""


class TooShortError(DataError):
    """Measured rollouts are sound and fit, and are too short for what is asked of them."""


class ModelError(NpdrError, ValueError):
    """A model, prior, simulator, port or effect is declared wrongly."""


class ShapeError(NpdrError, ValueError):
    """A tensor has a shape that does not fit."""


class IntractableError(NpdrError, NotImplementedError):
    """A density was asked for that a black-box simulator does not have."""


class SimulationError(NpdrError, RuntimeError):
    """A simulator failed or returned something unusable."""


class BackendError(NpdrError, ValueError):
    """An inference backend is unknown, misconfigured or cannot handle the problem."""


class DependencyError(NpdrError, ImportError):
    """An optional package is needed and absent."""


class CompilationError(NpdrError, RuntimeError):
    """A time loop was to be compiled, and the compiler failed."""
