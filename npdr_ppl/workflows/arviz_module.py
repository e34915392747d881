"""ArviZ, imported in one place, which knows the differences between its releases."""

import warnings

with warnings.catch_warnings():
    # ArviZ 0.23 announces its next major release on every import.
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az

__all__ = ["az"]
