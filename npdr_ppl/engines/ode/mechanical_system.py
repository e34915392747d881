"""Base class of mechanical systems whose authors write the accelerations in torch."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import Tables
from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.engines.common.compilation import CompileMode
from npdr_ppl.engines.common.effect_chain import needed_histories
from npdr_ppl.engines.common.integrators import Components, Integrator, integrator
from npdr_ppl.engines.ode.declaration import check_declaration
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect, EnvironmentEffect

__all__ = ["Forces", "MechanicalSystem"]

Forces = tuple[Tensor | float, ...]
"""Generalised forces to add, one per joint; 0.0 where no effect acts."""


class MechanicalSystem(ClosedLoopSimulator):
    """A second-order mechanical system q̈ = a(q, q̇, u, f), for a whole batch at once.

    A subclass declares channels, parameters and ports, and writes :meth:`accelerations`. The
    state is the positions, then the velocities, in the order of ``joints``; every velocity names
    its position in ``rate_of``.

    Computations use the widest floating type among the given parameters and the inputs' actions,
    on the device of the actions.

    Args:
        integrator: Name of the integration method; ``None`` for the model's default.
        substeps: Integration steps per time step.
        compile: Whether to compile the time loop. ``auto`` compiles if there is a compiler and
            one call is large enough to save the about ten seconds that compilation takes.

    Attributes:
        joints: Names of the force ports, one per generalised coordinate.
        default_integrator: The model's integration method.
    """

    is_deterministic = True
    is_differentiable = True
    joints: tuple[str, ...]
    default_integrator: str = "rk4"

    def __init__(
        self,
        *,
        integrator: str | None = None,
        substeps: int = 1,
        compile: CompileMode = "auto",
    ) -> None:
        if substeps < 1:
            raise ModelError(f"{self.name} needs at least one substep, got {substeps=}.")
        if compile not in ("auto", "always", "never"):
            raise ModelError(f"compile is 'auto', 'always' or 'never', got {compile!r}.")
        check_declaration(self, getattr(self, "joints", ()))
        self.integrator: Integrator = _integrator(integrator or self.default_integrator)
        self.substeps = substeps
        self.compile: CompileMode = compile

    @abstractmethod
    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: Any,
    ) -> Components:
        """Returns the acceleration of each joint; must be affine in ``forces``.

        Args:
            positions: Generalised positions, one tensor per joint.
            velocities: Their rates.
            actions: Commands, limited to their channels' bounds and changed by action effects.
            forces: Generalised forces of attached effects, to add to the joints' own forces.
            constants: The result of :meth:`constants`.
        """

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached; see :meth:`Simulator.with_effects`.

        Raises:
            ModelError: An effect changes a quantity that :meth:`environment` does not return.
        """
        changed = super().with_effects(*effects)
        asked = [effect for effect in effects if isinstance(effect, EnvironmentEffect)]
        known = self.environment(self.nominal()) if asked else {}
        for effect in asked:
            if effect.port not in known:
                raise ModelError(
                    f"{effect.id} cannot attach to {effect.port!r} of {self.name}, because its "
                    "environment() returns no such quantity."
                )
        return changed

    def environment(self, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Returns the quantities of the environment ports, by port name.

        By default a port in m/s² is the vector (x, y, z) of gravity on a level base, with the
        magnitude of the parameter of that name, and a port in kg is a payload of zero. A component
        that is the number 0.0 needs no computation. A model with a port of kind ``servo`` adds its
        :class:`~npdr_ppl.language.effect_context.Servo`.
        """
        environment: dict[str, Any] = {}
        for port in self.ports:
            if port.kind == "environment" and port.unit == "m/s²":
                environment[port.name] = (0.0, 0.0, -parameters[port.name])
            elif port.kind == "environment" and port.unit == "kg":
                environment[port.name] = 0.0
        return environment

    def constants(self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]) -> Any:
        """Returns the constants for :meth:`accelerations`, computed once per simulation.

        Tuples and dictionaries of tensors may be nested. The default is a dictionary of the
        parameters by name, in which the environment's quantities replace equal names.
        """
        return {**parameters, **environment}

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: Any
    ) -> tuple[Components, ...] | None:
        """Returns the rows of W = ∂a/∂f, or ``None`` to compute it with unit forces."""
        return None

    def readings(
        self, positions: Components, velocities: Components, constants: Any
    ) -> Components:
        """Returns the true value of every sensor channel; by default the state of that name."""
        values = dict(zip((s.name for s in self.states), (*positions, *velocities), strict=True))
        return tuple(values[sensor.name] for sensor in self.sensors)

    @property
    def rate_lag(self) -> float:
        """Time shift between velocities and derivatives of positions, as a fraction of a step."""
        return self.integrator.rate_lag / self.substeps

    def common_dtype(self, parameters: Mapping[str, Tensor], other: Tensor) -> torch.dtype:
        """Returns the widest floating type among the tensors."""
        dtype = other.dtype
        for value in parameters.values():
            if isinstance(value, Tensor) and value.is_floating_point():
                dtype = torch.promote_types(dtype, value.dtype)
        return dtype

    def tables(
        self,
        parameters: Mapping[str, Tensor],
        shape: torch.Size,
        time_step: float,
        *,
        expand: bool = False,
    ) -> tuple[Tables, tuple[int, ...]]:
        """Returns the constants of a simulation, flat, and the lengths of effects' histories.

        Args:
            parameters: The result of :meth:`complete`, each broadcasting to ``shape``.
            shape: Shape of the batch, of numel N.
            time_step: Seconds per step.
            expand: Whether to expand constant values, too; see :func:`flatten`.
        """
        effects = tuple(effect.own_parameters(parameters) for effect in self.effects)
        environment = self.environment(parameters)
        for effect, values in zip(self.effects, effects, strict=True):
            if isinstance(effect, EnvironmentEffect):
                quantity = environment[effect.port]
                environment[effect.port] = effect.environment(quantity, values)
        constants = self.constants(parameters, environment)
        histories = needed_histories(self.effects, effects, time_step)
        return flatten(Tables(constants, effects), shape, expand=expand), histories


def _integrator(name: str) -> Integrator:
    """Returns the integrator called ``name``; the argument ``integrator`` hides the function."""
    return integrator(name)
