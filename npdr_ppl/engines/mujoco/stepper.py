"""Advances a batch of MuJoCo simulations with effects, one control step at a time."""

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.effect_chain import EffectChain
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.mujoco.batches import state_view
from npdr_ppl.engines.mujoco.channels import Component, Reading
from npdr_ppl.engines.mujoco.damping import fastest_damping
from npdr_ppl.engines.mujoco.drive_forces import DriveForces, has_direct_drives
from npdr_ppl.engines.mujoco.joints import JointStates
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.ports import TO_QUATERNION, ForcePort, body_axis
from npdr_ppl.engines.mujoco.second_joints import IMMOVABLE
from npdr_ppl.engines.mujoco.servos import ServoErrors

__all__ = ["ACCELERATION_STAGE", "MujocoStepper", "lost_simulations"]

ACCELERATION_STAGE = 3
"""Stage of sensors that depend on accelerations."""

_MOST_DAMPED_PER_PART = 0.5
"""Rate of the fastest damping, per part of a step, up to which the midpoint rule follows it: its
decay over a part is then accurate to 3 %."""


class MujocoStepper(EffectChain):
    """Advances a batch whose engine stores the physical state.

    Viscous friction and springs are the engine's own; see
    :mod:`npdr_ppl.engines.mujoco.native_laws`. Other forces of effects are generalised forces,
    evaluated at the start of an engine step and constant during it. Dry friction is the engine's
    own friction loss; its bound is updated before every engine step.

    Args:
        simulator: The system and its effects.
        batch: A ``mujoco.batch.Batch`` of N simulations, or ``None`` if only commands and
            measurements pass through effects.
        time_step: Seconds per control step.
        histories: Number of past commands that each action effect may need, then of past values
            that each sensor effect may need.

    Attributes:
        has_forces: Whether effects have to be evaluated before every engine step.
        is_lost: Simulations about which the engine warned, ``(N,)``; they report NaN.
    """

    def __init__(
        self,
        simulator: MujocoMechanism,
        batch: Any,
        time_step: float,
        histories: tuple[int, ...],
    ) -> None:
        self.substeps = simulator.num_substeps(time_step)
        self._engine_step = time_step / self.substeps
        mujoco: Any = importlib.import_module("mujoco")
        is_fourth = simulator.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        super().__init__(
            simulator,
            simulator.joints,
            time_step,
            histories,
            force_step=self._engine_step,
            # The other integrators advance positions with the velocities at the end of a step.
            rate_lag=0.0 if is_fourth else 0.5 / self.substeps,
        )
        self.simulator: MujocoMechanism = simulator
        self.forces.effects = [f for f in self.forces.effects if not simulator.is_native(f[1])]
        # Velocities along a floating body's own axes are computed only where an effect acts.
        self._acted_on = {effect.port for _, effect, _ in self.forces.effects}
        servo_effects = simulator.servo_effects
        self.has_forces = bool(servo_effects or self.forces.effects)
        self._batch = batch
        self._module: Any = importlib.import_module("mujoco.batch")
        self._qpos, self._qvel = state_view(batch, "qpos"), state_view(batch, "qvel")
        self._ctrl = state_view(batch, "ctrl")
        stages = {s.stage for s in simulator.readings if isinstance(s, Reading)}
        self._sensordata = batch.bind("sensordata") if stages else None
        # Position and velocity sensors are one engine step behind the state until they are
        # computed again. Acceleration sensors report the values of the last engine step.
        self._stage = max(stages - {ACCELERATION_STAGE}, default=0)
        self._has_accelerations = ACCELERATION_STAGE in stages
        self._applied = state_view(batch, "qfrc_applied") if self.forces.effects else None
        self._seconds = tuple(simulator.second_joints.values())
        # Indices in qpos and qvel of all that is no second joint.
        self._first_columns = (
            np.setdiff1d(np.arange(simulator.model.nq), [s.position for s in self._seconds]),
            np.setdiff1d(np.arange(simulator.model.nv), [s.velocity for s in self._seconds]),
        )
        if self._seconds:
            # What is bound later has no values until the engine computes once more.
            self._accelerations, self._passive, self._bias = (
                batch.bind(name) for name in ("qacc", "qfrc_passive", "qfrc_bias")
            )
        self._servos = ServoErrors(
            simulator.model,
            servo_effects,
            self._ctrl,
            self._qpos,
            self._qvel,
            is_fourth=is_fourth,
        )
        # The bounds of dry friction that the engine reads, and the bounds without effects.
        self._friction: tuple[np.ndarray, np.ndarray] | None = None
        self._joints: JointStates | DriveForces | None = None
        if self.forces.needs_joints:
            is_light = self.forces.needs_only_drives and has_direct_drives(batch.model)
            source = DriveForces if is_light else JointStates
            self._joints = source(batch, simulator.force_ports)
        self.is_lost = torch.zeros(batch.nsim, dtype=torch.bool)

    @property
    def num_positions(self) -> int:
        """Number of the simulator's states that are positions."""
        return sum(not component.is_velocity for component in self.simulator.components)

    @property
    def num_parts(self) -> int:
        """In how many parts of a step late measurements are moved to the present."""
        simulator = self.simulator.rigid or self.simulator
        rate = fastest_damping(simulator.model, simulator.initial_positions)
        return max(1, math.ceil(rate * self.time_step / _MOST_DAMPED_PER_PART))

    def start(self, *args: Any, **kwargs: Any) -> State:
        """Returns the state at the start of an episode or segment; see the base class."""
        return super().start(*args, **kwargs)._replace(servo_memory=self._servos.initial_memory())

    def place(self, components: Components, chosen: Tensor | None = None) -> None:
        """Sets the simulations' states; second joints stay as they are.

        What is no component of the state gets the simulator's initial position, and rests.

        Args:
            components: Components of the simulator's state, ``(N,)`` each.
            chosen: Which simulations to set, a mask ``(N,)``; by default all.
        """
        rows = self._rows(chosen)[:, None]
        positions, rates = self._first_columns
        self._qpos[rows, positions] = self.simulator.initial_positions[positions]
        self._qvel[rows, rates] = 0.0
        for component, value in zip(self.simulator.components, components, strict=True):
            where = self._qvel if component.is_velocity else self._qpos
            where[rows, component.address] = value.numpy()[rows]

    def restart(self, components: Components, chosen: Tensor | None = None) -> None:
        """Sets states as :meth:`place` does, and forgets what else the simulations went through.

        Args:
            components: Components of the simulator's state, ``(N,)`` each.
            chosen: Which simulations to set, a mask ``(N,)``; by default all.
        """
        self.place(components, chosen)
        rows = self._rows(chosen)
        for name in ("time", "act", "warmstart"):
            state_view(self._batch, name)[rows] = 0.0
        self._batch.warning[rows] = 0
        self.is_lost[torch.from_numpy(rows)] = False

    def _rows(self, chosen: Tensor | None) -> NDArray[np.int64]:
        """Returns the numbers of the chosen simulations, or of all."""
        return np.arange(len(self._qpos)) if chosen is None else chosen.numpy().nonzero()[0]

    def settle(
        self,
        state: State | None = None,
        tables: Tables | None = None,
        actions: Components = (),
        chosen: Tensor | None = None,
    ) -> None:
        """Places second joints, at rest, where their springs balance the forces on them.

        Args:
            state: The state as a segment begins; without it, only weights are balanced.
            tables: Constants of the simulation.
            actions: The first commands after all effects.
            chosen: Which simulations to change, a mask ``(N,)``; by default all.
        """
        if not self._seconds:
            return
        rows = self._rows(chosen)
        if not len(rows):
            return
        places = [second.position for second in self._seconds]
        at = [second.velocity for second in self._seconds]
        self._qpos[rows[:, None], places] = self._qvel[rows[:, None], at] = 0.0
        springs = self._batch.expand("jnt_stiffness")[:, [s.joint for s in self._seconds]]
        if state is None or tables is None:
            self._look(ACCELERATION_STAGE)
            forces = (self._passive - self._bias)[:, at]
        else:
            self._command(actions)
            self._servos.apply(tables, state.servo_memory, self._engine_step)
            if self.forces.effects:
                positions, velocities = self.at_joints((), ())
                self._apply(state._replace(positions=positions, velocities=velocities), tables)
            # The acceleration of an immovable joint, times its inertia, is the force on it.
            inertias = self._batch.expand("dof_armature")
            own = inertias[:, at].copy()
            inertias[:, at] = IMMOVABLE
            self._look(ACCELERATION_STAGE)
            forces = IMMOVABLE * self._accelerations[:, at]
            inertias[:, at] = own
        self._qpos[rows[:, None], places] = (forces / springs)[rows]

    def begin(self) -> None:
        """Computes the sensor values before the first step."""
        if self._sensordata is None:
            return
        stages: Any = importlib.import_module("mujoco").mjtStage
        self._look(stages.mjSTAGE_ACC if self._has_accelerations else stages.mjSTAGE_VEL)

    def accelerations(
        self, positions: Components, velocities: Components, actions: Components, tables: Tables
    ) -> Components:
        """Returns the rate of each velocity among the states, without any effect."""
        views = self._qpos, self._qvel, self._ctrl
        kept = [view.copy() for view in views]
        self.place((*positions, *velocities))
        self._command(actions)
        result = self._batch.bind("qacc")
        self._look(ACCELERATION_STAGE)
        columns = [c.address for c in self.simulator.components if c.is_velocity]
        rates = tuple(_column(result, column) for column in columns)
        for view, values in zip(views, kept, strict=True):
            view[:] = values
        self.begin()
        return rates

    def _look(self, stage: int) -> None:
        """Computes forward stages in the present state without changing it."""
        # The solver's first guess is part of the state and must not change here either.
        guess = state_view(self._batch, "warmstart")
        kept = guess.copy()
        self._guarded(self._batch.forward, stage=int(stage))
        guess[:] = kept

    def _command(self, actions: Components) -> None:
        for i, action in enumerate(actions):
            self._ctrl[:, i] = action.numpy()

    def at_joints(
        self, positions: Components, velocities: Components
    ) -> tuple[Components, Components]:
        """Returns position and velocity at every force port; NaN where there is no position."""
        ports = self.simulator.force_ports
        unknown = torch.full((len(self._qpos),), torch.nan, dtype=torch.float64)
        return (
            tuple(
                unknown if p.position is None else _column(self._qpos, p.position) for p in ports
            ),
            tuple(self._velocity(port) for port in ports),
        )

    def _velocity(self, port: ForcePort) -> Tensor:
        if port.axis is None or port.port.name not in self._acted_on:
            return _column(self._qvel, port.velocity)
        along = self._direction(port) * self._qvel[:, port.in_world]
        return torch.from_numpy(along.sum(axis=1))

    def _direction(self, port: ForcePort) -> NDArray[np.float64]:
        """Returns the axis of a floating body in the world's frame, ``(N, 3)``."""
        assert port.axis is not None
        first = int(self.simulator.model.jnt_qposadr[port.joint]) + TO_QUATERNION
        return body_axis(self._qpos[:, first : first + 4], port.axis)

    @property
    def position_channels(self) -> tuple[str | None, ...]:
        """Name of the state that is the position of each hinge and slide."""
        names = self.simulator.position_states
        return tuple(names.get(joint) for joint in self.simulator.joints)

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel."""
        return tuple(self._read(sensor) for sensor in self.simulator.readings)

    def state(self) -> tuple[Components, Components]:
        """Returns the positions and velocities among the simulator's states."""
        components = self.simulator.components
        return (
            tuple(self._read(c) for c in components if not c.is_velocity),
            tuple(self._read(c) for c in components if c.is_velocity),
        )

    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Advances all simulations by one control step; see :meth:`EffectChain.move`."""
        if not any(moment is not None for moment in moments):
            return self.follow(state, [actions], tables)
        return self.follow(
            state, self.actions.by_substep(actions, moments, self.substeps)[0], tables
        )

    def follow(self, state: State, actions: Sequence[Components], tables: Tables) -> State:
        """Advances all simulations by one control step.

        Args:
            state: State at its start.
            actions: Actions after all effects, for each engine step or one for all of them.
            tables: Constants of the simulation.
        """
        if len(actions) == 1 and not self.has_forces:
            self._command(actions[0])
            self._guarded(self._batch.step, nstep=self.substeps, stage=self._stage)
        else:
            for k in range(self.substeps):
                self._command(actions[k % len(actions)])
                stage = self._stage if k == self.substeps - 1 else 0
                state = self._move_once(state, tables, stage)
        positions, velocities = self.state()
        return state._replace(positions=positions, velocities=velocities)

    def _move_once(self, state: State, tables: Tables, stage: int) -> State:
        """Advances all simulations by one engine step under the force effects."""
        servo_memory = self._servos.apply(tables, state.servo_memory, self._engine_step)
        state = state._replace(servo_memory=servo_memory)
        if not self.forces.effects:
            self._guarded(self._batch.step, stage=stage)
            return state
        positions, velocities = self.at_joints((), ())
        state = state._replace(positions=positions, velocities=velocities)
        if self._joints is not None:
            if isinstance(self._joints, JointStates):
                self._apply(state, tables, before_step=True)
                self._look(ACCELERATION_STAGE)
            state = self.forces.begin_step(state, self._joints.read(positions, velocities), tables)
        self._apply(state, tables)
        memory = self.forces.next_memory(state, tables)
        self._guarded(self._batch.step, stage=stage)
        return state._replace(force_memory=memory)

    def _apply(self, state: State, tables: Tables, *, before_step: bool = False) -> None:
        """Passes the effects' forces to the engine; see :meth:`ForceEffects.smooth_forces`.

        With ``before_step``, their dry friction is left out.
        """
        assert self._applied is not None
        ports = self.simulator.force_ports
        forces = self.forces.smooth_forces(
            state.positions, state.velocities, state, tables, before_step=before_step
        )
        if before_step:
            # Removes the previous step's forces of effects that need their joint's state first.
            self._applied[:] = 0.0
        along = []
        for port, force in zip(ports, forces, strict=True):
            if force is not None and port.axis is None:
                self._applied[:, port.velocity] = force.numpy()
            elif force is not None:
                along.append((port, force.numpy()))
        for port, _ in along:
            self._applied[:, port.in_world] = 0.0
        for port, force in along:
            self._applied[:, port.in_world] += self._direction(port) * force[:, None]
        if before_step:
            if self._friction is not None:
                present, own = self._friction
                present[:] = own
            return
        for port, bound in zip(ports, self.forces.dry_friction_bounds(state, tables), strict=True):
            if bound is not None:
                if self._friction is None:
                    bounds = self._batch.expand("dof_frictionloss")
                    self._friction = bounds, bounds.copy()
                present, own = self._friction
                present[:, port.velocity] = own[:, port.velocity] + bound.numpy()

    def _guarded(self, run: Any, **options: int) -> None:
        """Runs a method of the batch and notes the simulations that were lost."""
        try:
            run(**options)
        except self._module.SimulationError as error:
            self.is_lost[torch.as_tensor(np.array(error.ids), dtype=torch.long)] = True
        self.is_lost |= torch.from_numpy(lost_simulations(self._batch))

    def _read(self, what: Component | Reading) -> Tensor:
        if isinstance(what, Reading):
            assert self._sensordata is not None
            values = _column(self._sensordata, what.address)
        else:
            values = _column(self._qvel if what.is_velocity else self._qpos, what.address)
        return torch.where(self.is_lost, torch.nan, values)


def lost_simulations(batch: Any) -> np.ndarray:
    """Returns about which simulations the engine has warned, ``(N,)``."""
    return np.asarray(np.asarray(batch.warning)[..., 1].any(axis=1))


def _column(table: np.ndarray, column: int) -> Tensor:
    # A copy: the table changes with the next step.
    return torch.from_numpy(table[:, column].copy())
