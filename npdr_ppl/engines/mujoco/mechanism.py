"""An MJCF file as a mechanism: channels, parameters and ports, and batches of simulations."""

import copy
import importlib
import logging
import math
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Tables
from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.engines.common.effect_chain import needed_histories
from npdr_ppl.engines.common.robot_files import located
from npdr_ppl.engines.common.source_files import recorded_mjcf
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.batches import make_batch, prepared_copy, quiet
from npdr_ppl.engines.mujoco.channels import (
    Component,
    Reading,
    Selection,
    action_channels,
    choose,
    mjcf_sensors,
    spins,
    state_components,
)
from npdr_ppl.engines.mujoco.coupled_joints import coupled_joints
from npdr_ppl.engines.mujoco.environment import environment_ports, with_environment
from npdr_ppl.engines.mujoco.fields import element_names, find_field
from npdr_ppl.engines.mujoco.native_laws import is_native, native_law
from npdr_ppl.engines.mujoco.parameters import Assignments, Binding, Bindings, Derivation
from npdr_ppl.engines.mujoco.ports import (
    TO_QUATERNION,
    body_axis,
    derive_ports,
    driven_dofs,
    force_ports,
)
from npdr_ppl.engines.mujoco.second_joints import (
    SecondJoint,
    WithSecondJoints,
    with_second_joints,
)
from npdr_ppl.engines.mujoco.servos import check_servo, with_servos
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel, Follower, Spin
from npdr_ppl.language.effects import (
    ComplianceEffect,
    Effect,
    EnvironmentEffect,
    ForceEffect,
    ParameterEffect,
    ServoEffect,
)
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.registry import hint

__all__ = ["MujocoMechanism"]

logger = logging.getLogger(__name__)


class MujocoMechanism(ClosedLoopSimulator):
    """An MJCF file with its channels, parameters and ports, and batches of simulations of it.

    Arguments and errors are those of :class:`~npdr_ppl.engines.mujoco.simulator.MujocoSimulator`.

    Attributes:
        model: The ``mujoco.MjModel``.
        components: Where MuJoCo stores each state.
        readings: Where MuJoCo stores each sensor's value.
        force_ports: The force ports with the coordinates they act on.
        file: The MJCF or URDF file; ``None`` for a compiled model.
    """

    uses_threads = True
    takes_servo_effects = True
    takes_compliance = True
    # The simulator without second joints, once effects have added some.
    rigid: Self | None = None
    # Requested engine steps per engine step; see MujocoSimulator.with_coarser_steps.
    coarsening = 1

    def __init__(
        self,
        source: str | PathLike[str] | Any,
        parameters: Mapping[str, Binding] | None = None,
        *,
        derived: Mapping[str, Derivation] | None = None,
        states: Selection = None,
        sensors: Selection = None,
        units: Mapping[str, str] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        time_step: float | None = None,
        substeps: int | None = None,
        num_threads: int | None = None,
        keyframe: str | None = None,
        held: Iterable[str] = (),
    ) -> None:
        if substeps is not None and substeps < 1:
            raise ModelError(f"MujocoSimulator needs at least one substep, got {substeps=}.")
        source = located(source)
        with quiet(logger.warning):
            self.model: Any = load_mjcf(source)
        self._source = recorded_mjcf(source)
        self.file = Path(source) if isinstance(source, str | PathLike) else None
        self.prepared_models: dict[tuple[object, ...], Any] = {}
        # Models in which some joints have a second one, by the numbers of these joints.
        self.with_second: dict[tuple[int, ...], WithSecondJoints] = {}
        # The second joint of each port that has one.
        self.second_joints: dict[str, SecondJoint] = {}
        # The MJCF text with them; empty without any.
        self.text_with_second = ""
        is_path = isinstance(source, str | PathLike)
        self._label = Path(source).name if is_path else "a model"
        self.substeps, self.num_threads = substeps, num_threads
        # Engine steps per requested engine step; see MujocoSimulator.with_finer_steps.
        self.refinement = 1
        self.time_step = time_step or (substeps or 1) * float(self.model.opt.timestep)
        self._declare_channels(states, sensors, units or {}, bounds or {})
        taken = [channel.name for channel in (*self.states, *self.sensors, *self.actions)]
        self.force_ports = force_ports(self.model, taken)
        self._bound = parameters or {}, derived or {}
        self.bindings = Bindings(self.model, *self._bound)
        self.parameters = self.bindings.parameters
        self._held_at = self._ports_with_held_damping(held)
        taken += [*self.joints, *(parameter.name for parameter in self.parameters)]
        self._environment = environment_ports(self.model, driven_dofs(self.model), taken)
        self.ports = (
            *derive_ports(self.model, self.force_ports, self.actions, self.readings),
            *(port.port for port in self._environment),
        )
        # This reports wrong derivations at construction.
        self.bindings.assignments({}, self.nominal())
        self.initial_positions = self._initial_positions(keyframe)

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"MujocoSimulator({self._label})"

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the force ports."""
        return tuple(port.port.name for port in self.force_ports)

    def corrected_number(self, effect: Effect) -> str:
        """Returns the damping that viscous friction at the same joint would correct, if held."""
        if not isinstance(effect, ForceEffect) or effect.standard_law != "damping":
            return ""
        return self._held_at.get(effect.port, "")

    def speeds_at_starts(self, inputs: Inputs) -> dict[str, Tensor]:
        """Returns those of all force ports: an MJCF does not tell how fast its joints move."""
        states = zip(self.components, self.initial_states(inputs), strict=True)
        found = {(c.is_velocity, c.address): value.double() for c, value in states}
        result = {}
        for port in self.force_ports:
            needed = [(True, port.velocity)]
            if port.axis is not None:
                first = int(self.model.jnt_qposadr[port.joint]) + TO_QUATERNION
                needed = [(True, k) for k in range(port.in_world.start, port.in_world.stop)]
                needed += [(False, first + k) for k in range(4)]
            if not all(place in found for place in needed):
                continue
            values = torch.stack([found[place].reshape(-1) for place in needed], dim=-1).numpy()
            if port.axis is not None:
                values = body_axis(values[:, 3:], port.axis) * values[:, :3]
            result[port.port.name] = torch.from_numpy(values.sum(-1))
        return result

    @property
    def position_states(self) -> dict[str, str]:
        """State that is the position of the joint at each force port, if there is one."""
        states = zip(self.components, self.states, strict=True)
        names = {c.address: state.name for c, state in states if not c.is_velocity}
        ports = self.force_ports
        return {
            p.port.name: names[p.position]
            for p in ports
            if p.position is not None and p.position in names
        }

    @property
    def followers(self) -> tuple[Follower | Spin, ...]:
        """States of joints that equality constraints tie to others, and spins."""
        tied = coupled_joints(self.model, self.components, self.states)
        return *tied, *spins(self.model, self.components, self.states)

    def recorded_settings(self) -> dict[str, Any]:
        """Returns the MJCF's text, the fields that parameters set, and the engine's version."""
        return {
            "engine": "mujoco",
            "version": importlib.import_module("mujoco").__version__,
            "mjcf": self._source,
            "parameters": {p.name: p.description for p in self.parameters},
            "time_step": self.time_step,
            "substeps": self.num_substeps(self.time_step),
        }

    @property
    def is_rate(self) -> tuple[bool, ...]:
        """Whether each state is a velocity, also of ball joints and free bodies."""
        return tuple(component.is_velocity for component in self.components)

    def num_substeps(self, time_step: float) -> int:
        """Returns the engine steps per control step of ``time_step`` seconds."""
        suggested = max(1, round(time_step / float(self.model.opt.timestep)))
        return -(-self.refinement * (self.substeps or suggested) // self.coarsening)

    def histories(self, given: Mapping[str, Tensor], time_step: float) -> tuple[int, ...]:
        """Returns how many past steps each action effect, then each sensor effect, needs.

        Args:
            given: Given parameters.
            time_step: Seconds per step.
        """
        own = tuple(effect.own_parameters(given) for effect in self.effects)
        return needed_histories(self.effects, own, time_step)

    def make_batch(
        self, given: Mapping[str, Tensor], num_simulations: int, time_step: float, time: Tensor
    ) -> tuple[Any, Tables]:
        """Returns a batch with its parameters set, and the effects' parameters.

        Args:
            given: Given parameters, ``(N,)`` or numbers, in float64.
            num_simulations: N.
            time_step: Seconds per control step.
            time: Seconds from the start of the rollout to the middle of each segment.
        """
        step = time_step / self.num_substeps(time_step)
        assignments, own = self.assignments(given, time, step)
        model = self.prepared(step, set(assignments))
        num_threads = self.num_threads or torch.get_num_threads()
        return make_batch(model, assignments, num_simulations, num_threads), Tables(None, own)

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached after the present ones; see the base class."""
        changed = super().with_effects(*effects)
        for _, effect, actuator in changed.servo_effects:
            check_servo(self.model, actuator, effect.id)
        return changed.carrying(changed.effects)

    def carrying(self, effects: Iterable[Effect]) -> Self:
        """Returns a copy with these effects only, and with the second joints that they need.

        Args:
            effects: The effects, which can be attached to it.
        """
        changed = copy.copy(self)
        changed.effects = tuple(effects)
        yielding = {e.port for e in changed.effects if isinstance(e, ComplianceEffect)}
        if yielding == self.second_joints.keys():
            return changed
        rigid = self.rigid or self
        if not yielding:
            return rigid.carrying(changed.effects)
        chosen = [p for p in rigid.force_ports if p.port.name in yielding]
        key = tuple(port.joint for port in chosen)
        if key not in rigid.with_second:
            rigid.with_second[key] = with_second_joints(rigid.file, rigid.model, key)
        found = rigid.with_second[key]
        # Cached for the rigid model; a model with second joints has no inverse dynamics.
        vars(changed).pop("inverse_dynamics", None)
        changed.rigid, changed.prepared_models = rigid, {}
        changed.model = copy.copy(found.model)
        changed.model.opt.integrator = rigid.model.opt.integrator
        changed.text_with_second = found.text
        changed.second_joints = {
            port.port.name: second for port, second in zip(chosen, found.seconds, strict=True)
        }
        changed.components = tuple(map(found.component, rigid.components))
        changed.readings = tuple(
            found.component(r) if isinstance(r, Component) else r for r in rigid.readings
        )
        changed.force_ports = tuple(map(found.port, rigid.force_ports))
        changed.bindings = Bindings(changed.model, *self._bound)
        changed.initial_positions = found.pose(rigid.initial_positions)
        return changed

    @property
    def servo_effects(self) -> list[tuple[int, ServoEffect, int]]:
        """Index among the effects, effect and number of the actuator of each servo effect."""
        names = [action.name for action in self.actions]
        return [
            (place, effect, names.index(effect.port))
            for place, effect in enumerate(self.effects)
            if isinstance(effect, ServoEffect)
        ]

    def assignments(
        self, given: Mapping[str, Tensor], time: Tensor, step: float | None = None
    ) -> tuple[Assignments, tuple[dict[str, Tensor], ...]]:
        """Returns what to write into the model, and the effects' parameters by short name.

        Args:
            given: Given parameters, ``(N,)`` or numbers, in float64.
            time: Seconds from the start of the rollout to the middle of each segment.
            step: Seconds per engine step; its own by default.
        """
        step = step or self.time_step / self.num_substeps(self.time_step)
        complete = self.complete(given, torch.float64, torch.device("cpu"))
        domain = self.changed(complete, time)
        drifting = {e.port for e in self.effects if isinstance(e, ParameterEffect)}
        given = {**given, **{name: domain[name] for name in drifting}}
        own = tuple(effect.own_parameters(domain) for effect in self.effects)
        assignments = self.bindings.assignments(given, domain)
        assignments = with_environment(
            self.model, self._environment, self.effects, own, assignments
        )
        commands = [action.name for action in self.actions]
        assignments = with_servos(self.model, commands, self.effects, own, assignments)
        by_port = {port.port.name: port for port in self.force_ports}
        for effect, values in zip(self.effects, own, strict=True):
            if isinstance(effect, ForceEffect) and self.is_native(effect):
                port = by_port[effect.port]
                assignments |= native_law(self.model, port, effect, values, assignments)
        # These come last: how heavy a carrier has to be follows from its joint's damping.
        for effect, values in zip(self.effects, own, strict=True):
            if isinstance(effect, ComplianceEffect):
                second, carrier = self.second_joints[effect.port], effect.carrier(values)
                assignments |= second.assignments(self.model, carrier, step, assignments)
        return assignments, own

    def is_native(self, effect: Effect) -> bool:
        """Returns whether the engine's model has the effect, so that no further force acts."""
        if isinstance(effect, EnvironmentEffect | ComplianceEffect):
            return True
        ports = [p for p in self.force_ports if p.port.name == effect.port]
        if not isinstance(effect, ForceEffect) or not ports:
            return False
        if effect.standard_law == "dry friction" and any(
            isinstance(other, ForceEffect) and other.needs_joint and not other.needs_only_drive
            for other in self.effects
        ):
            # The accelerations that those get are without dry friction of other effects.
            return False
        return is_native(self.model, ports[0], effect, self.bindings.places)

    def prepared(self, step: float, assigned: set[tuple[str, int]]) -> Any:
        """Returns a model for batches, from a cache if possible.

        Args:
            step: Seconds per engine step.
            assigned: Arrays and places that parameters and effects set.
        """
        dofs = {
            port.velocity
            for port in self.force_ports
            for effect in self.effects
            if isinstance(effect, ForceEffect) and effect.port == port.port.name
            if not port.port.is_floating  # where nothing rubs
        }
        # If the file has dry friction, or a parameter sets it, the file's solver settings stay.
        width = int(self.model.dof_solimp.shape[1])
        crisp = tuple(
            dof
            for dof in sorted(dofs)
            if self.model.dof_frictionloss[dof] == 0.0
            and ("dof_frictionloss", dof) not in assigned & self.bindings.places
            and ("dof_solimp", dof * width) not in self.bindings.places
        )
        may_add = bool(crisp) or any(array.endswith("frictionloss") for array, _ in assigned)
        names = [action.name for action in self.actions]
        changed = {names.index(e.port) for e in self.effects if e.port in names}
        limits = {place // 2 for array, place in assigned if array == "actuator_forcerange"}
        unlimited = tuple(
            a for a in sorted(limits & changed) if not self.model.actuator_forcelimited[a]
        )
        key = step, crisp, may_add, unlimited, self.coarsening
        if key not in self.prepared_models:
            own = prepared_copy(self.model, step, crisp, unlimited, keeps_solver=may_add)
            mujoco: Any = importlib.import_module("mujoco")
            if self.coarsening > 1 and own.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
                # Longer explicit steps could make stiff servos unstable.
                own.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            self.prepared_models[key] = own
        return self.prepared_models[key]

    def _declare_channels(
        self,
        states: Selection,
        sensors: Selection,
        units: Mapping[str, str],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        """Sets states, sensors and actions."""
        known = {c.channel.name: c for c in state_components(self.model)}
        chosen: tuple[Component, ...] = choose(known, states, "state")
        # Positions come first, as everywhere.
        self.components = tuple(sorted(chosen, key=lambda component: component.is_velocity))

        def finished(channel: Channel) -> Channel:
            lower, upper = bounds.get(channel.name, (-math.inf, math.inf))
            unit = units.get(channel.name, channel.unit)
            return Channel(channel.name, unit, lower, upper, channel.rate_of)

        self.states = tuple(finished(c.channel) for c in self.components)
        things: dict[str, Component | Reading] = {
            r.channel.name: r for r in mjcf_sensors(self.model)
        }
        # A sensor element with the name of a state usually measures that state; the name then
        # stands for the state.
        things |= {
            channel.name: Component(channel, c.address, c.is_velocity)
            for channel, c in zip(self.states, self.components, strict=True)
        }
        default = [channel.name for channel in self.states]
        self.readings: tuple[Component | Reading, ...] = choose(
            things, default if sensors is None else sensors, "state or sensor"
        )
        self.sensors = tuple(finished(r.channel) for r in self.readings)
        taken = [channel.name for channel in (*self.states, *self.sensors)]
        self.actions = tuple(
            Channel(a.name, units.get(a.name, a.unit), a.lower, a.upper)
            for a in action_channels(self.model, taken)
        )
        all_names = [*taken, *(action.name for action in self.actions)]
        for name in (*units, *bounds):
            if name not in all_names:
                raise ModelError(f"{self.name} has no channel {name!r}; {hint(name, all_names)}")

    def _ports_with_held_damping(self, held: Iterable[str]) -> dict[str, str]:
        """Returns the held fields that are joints' damping, by the joint's force port."""
        fields = [find_field(self.model, text) for text in held]
        dofs = {e.place for field in fields for e in field.entries if e.array == "dof_damping"}
        names = element_names(self.model, "joint")
        return {
            port.port.name: f"joint {names[port.joint]} damping"
            for port in self.force_ports
            if port.velocity in dofs
        }

    def _initial_positions(self, keyframe: str | None) -> Any:
        """Returns the qpos of components that are not states."""
        if keyframe is None:
            return np.array(self.model.qpos0)
        names = element_names(self.model, "key")
        if keyframe not in names:
            raise ModelError(f"{self.name} has no keyframe {keyframe!r}; {hint(keyframe, names)}")
        return np.array(self.model.key_qpos[names.index(keyframe)])
