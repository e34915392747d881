"""Fixed-step integrators for second-order mechanical systems q̈ = a(q, q̇)."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError

__all__ = ["INTEGRATORS", "Acceleration", "Components", "Integrator", "integrator"]

Components = tuple[Tensor, ...]
"""One tensor per generalised coordinate, all of one shape."""

Acceleration = Callable[[Components, Components], Components]
"""Maps positions q and velocities v to accelerations a."""

StepFn = Callable[
    [Acceleration, Components, Components, Components, float], tuple[Components, Components]
]


@dataclass(frozen=True)
class Integrator:
    """A one-step method with a constant step.

    Attributes:
        name: Name as an option of simulators.
        step: Function of the acceleration function, q, v, a(q, v) and the step h in seconds that
            returns the next q and v. The acceleration at the start is an argument because dry
            friction has computed it already.
        order: The global error is O(h^order).
        rate_lag: Time shift between a velocity and the derivative of the position, in either
            direction, as a fraction of a step. Staggered methods compute velocities at times
            between those of the positions.
    """

    name: str
    step: StepFn
    order: int
    rate_lag: float = 0.0


def _advance(x: Components, rate: Components, time: float) -> Components:
    """Returns x + time · rate."""
    # One operation instead of two, because the number of operations limits eager simulations.
    return tuple(torch.add(a, b, alpha=time) for a, b in zip(x, rate, strict=True))


def _constant_acceleration(
    acceleration: Acceleration, q: Components, v: Components, a: Components, h: float
) -> tuple[Components, Components]:
    """Advances v' = v + h a, q' = q + h v + h²/2 a; exact under constant acceleration."""
    return _advance(_advance(q, v, h), a, 0.5 * h * h), _advance(v, a, h)


def _semi_implicit_euler(
    acceleration: Acceleration, q: Components, v: Components, a: Components, h: float
) -> tuple[Components, Components]:
    """Advances v' = v + h a, q' = q + h v'; symplectic, so energy errors stay bounded."""
    velocities = _advance(v, a, h)
    return _advance(q, velocities, h), velocities


def _midpoint(
    acceleration: Acceleration, q: Components, v: Components, a: Components, h: float
) -> tuple[Components, Components]:
    """Advances by the rates at the middle of the step, which half an Euler step predicts."""
    middle = _advance(v, a, 0.5 * h)
    rates = acceleration(_advance(q, v, 0.5 * h), middle)
    return _advance(q, middle, h), _advance(v, rates, h)


def _rk4(
    acceleration: Acceleration, q: Components, v: Components, a: Components, h: float
) -> tuple[Components, Components]:
    """The classical Runge–Kutta method on (q, v), whose rates are (v, a)."""
    v2 = _advance(v, a, 0.5 * h)
    a2 = acceleration(_advance(q, v, 0.5 * h), v2)
    v3 = _advance(v, a2, 0.5 * h)
    a3 = acceleration(_advance(q, v2, 0.5 * h), v3)
    v4 = _advance(v, a3, h)
    a4 = acceleration(_advance(q, v3, h), v4)
    return _weighted(q, v, v2, v3, v4, h), _weighted(v, a, a2, a3, a4, h)


def _weighted(
    x: Components, r1: Components, r2: Components, r3: Components, r4: Components, h: float
) -> Components:
    """Returns x + h/6 (r1 + 2 r2 + 2 r3 + r4)."""
    # Four operations; see _advance.
    return tuple(
        torch.add(start, torch.add(a + d, b + c, alpha=2.0), alpha=h / 6.0)
        for start, a, b, c, d in zip(x, r1, r2, r3, r4, strict=True)
    )


INTEGRATORS: dict[str, Integrator] = {
    method.name: method
    for method in (
        Integrator("constant-acceleration", _constant_acceleration, order=1),
        Integrator("semi-implicit-euler", _semi_implicit_euler, order=1, rate_lag=0.5),
        Integrator("midpoint", _midpoint, order=2),
        Integrator("rk4", _rk4, order=4),
    )
}


def integrator(name: str) -> Integrator:
    """Returns the integrator called ``name``.

    Raises:
        ModelError: There is no integrator of that name.
    """
    try:
        return INTEGRATORS[name]
    except KeyError:
        raise ModelError(
            f"There is no integrator {name!r}; there are {', '.join(INTEGRATORS)}."
        ) from None
