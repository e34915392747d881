"""A rig with what is hidden in it, integrated in small steps for all rollouts at once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hidden_rigs.bursts import TorqueBursts
from hidden_rigs.command_laws import COMMAND_LAWS, CommandLaw
from hidden_rigs.force_laws import FORCE_LAWS
from hidden_rigs.friction_laws import BRISTLE_LAWS, DRY_LAWS, Bristles
from hidden_rigs.hidden import Hidden
from hidden_rigs.mechanics import Array, Flags, Mechanics, Surroundings, accelerations
from hidden_rigs.transmissions import TRANSMISSIONS, Transmission

__all__ = ["Layout", "Plant"]


@dataclass(frozen=True)
class Layout:
    """Which ports a rig has, in the words of the model under test.

    Attributes:
        joints: Force ports.
        actions: Action channels.
        positions: Sensor channels of the joints' positions.
        velocities: Sensor channels of their rates.
    """

    joints: tuple[str, ...]
    actions: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]

    @property
    def sensors(self) -> tuple[str, ...]:
        """All sensor channels, positions first."""
        return (*self.positions, *self.velocities)


class Plant:
    """Advances R rollouts of a rig by the classical Runge–Kutta method in substeps.

    Dry friction keeps its direction through a substep. A joint whose velocity changes its sign
    against friction stops there; a joint at rest stays as long as friction can hold it.

    Args:
        mechanics: Makes the equations of motion from parameters and surroundings.
        layout: Names of the ports.
        parameters: Domain parameters.
        hidden: What is hidden; effects on readings are not this class's.
        num_rollouts: R.
        substep: Seconds per substep.
        duration: Seconds of the recording.
        generator: Source of randomness.
    """

    def __init__(
        self,
        mechanics: Callable[[Mapping[str, float], Surroundings], Mechanics],
        layout: Layout,
        parameters: Mapping[str, float],
        hidden: Sequence[Hidden],
        *,
        num_rollouts: int,
        substep: float,
        duration: float,
        generator: np.random.Generator,
    ) -> None:
        self.substep = substep
        self._make = mechanics
        self._parameters = dict(parameters)
        self._surroundings = _surroundings(hidden)
        self._drifts = [h for h in hidden if h.effect_id == "parameter_drift"]
        self._mechanics = mechanics(parameters, self._surroundings)
        joint = {name: i for i, name in enumerate(layout.joints)}
        self._forces = [
            (joint[h.port], FORCE_LAWS[h.effect_id], h.parameters)
            for h in hidden
            if h.effect_id in FORCE_LAWS
        ]
        self._dry = [
            (joint[h.port], DRY_LAWS[h.effect_id], h.parameters)
            for h in hidden
            if h.effect_id in DRY_LAWS
        ]
        self._bristles: list[tuple[int, Bristles]] = [
            (joint[h.port], BRISTLE_LAWS[h.effect_id](h.parameters, num_rollouts))
            for h in hidden
            if h.effect_id in BRISTLE_LAWS
        ]
        self._bursts = [
            (joint[h.port], TorqueBursts(h.parameters, num_rollouts, duration, generator))
            for h in hidden
            if h.effect_id == "torque_bursts"
        ]
        self._commands: list[list[CommandLaw]] = [
            [
                COMMAND_LAWS[h.effect_id](h.parameters, substep)
                for h in hidden
                if h.port == action and h.effect_id in COMMAND_LAWS
            ]
            for action in layout.actions
        ]
        self._geared = -1
        self._transmission: Transmission | None = None
        for h in hidden:
            if h.effect_id in TRANSMISSIONS:
                self._geared = joint[h.port]
                self._transmission = Transmission(
                    h.parameters,
                    self._mechanics.drive_inertia(self._geared),
                    substep,
                    TRANSMISSIONS[h.effect_id],
                )
        self._drives: list[Array] = []
        self._dry_joints = sorted({place for place, _, _ in self._dry})

    def start(self, positions: Array, velocities: Array) -> tuple[Array, Array]:
        """Returns the state at rest in its gears, ``(joints or one more, R)`` each."""
        if self._transmission is None:
            return positions.copy(), velocities.copy()
        row = slice(self._geared, self._geared + 1)
        return np.vstack((positions, positions[row])), np.vstack((velocities, velocities[row]))

    def begin_step(self, time: float) -> None:
        """Lets parameters drift that do; time in s since the recording began."""
        if self._drifts:
            changed = dict(self._parameters)
            for h in self._drifts:
                changed[h.port] *= 1.0 + h.parameters["rate"] * max(time, 0.0)
            self._mechanics = self._make(changed, self._surroundings)

    def advance(
        self, q: Array, v: Array, commands: Sequence[Array], time: float
    ) -> tuple[Array, Array]:
        """Returns the state one substep later.

        Args:
            q: Positions, ``(joints or one more, R)``.
            v: Velocities.
            commands: One per action, ``(R,)`` each, constant over the substep.
            time: Seconds since the recording began.
        """
        passed = []
        for command, laws in zip(commands, self._commands, strict=True):
            for law in laws:
                command = law(command, q[0])
            passed.append(command)
        self._drives = self._mechanics.drives(passed)
        h = self.substep
        directions, held = self._friction_modes(q, v, time)
        a1 = self._rates(q, v, time, directions, held)
        v2 = v + 0.5 * h * a1
        a2 = self._rates(q + 0.5 * h * v, v2, time + 0.5 * h, directions, held)
        v3 = v + 0.5 * h * a2
        a3 = self._rates(q + 0.5 * h * v2, v3, time + 0.5 * h, directions, held)
        v4 = v + h * a3
        a4 = self._rates(q + h * v3, v4, time + h, directions, held)
        next_q = q + h / 6.0 * (v + 2.0 * (v2 + v3) + v4)
        next_v = v + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        for i in self._dry_joints:
            turned = next_v[i] * directions[i] < 0.0
            if turned.any():
                next_v = self._after_reversal(i, turned, v, next_q, next_v, a4, time + h)
        for i, bristles in self._bristles:
            bristles.advance(0.5 * (v[i] + next_v[i]), h)
        return next_q, next_v

    def _after_reversal(
        self,
        joint: int,
        turned: Flags,
        v: Array,
        next_q: Array,
        next_v: Array,
        last: Array,
        time: float,
    ) -> Array:
        """Returns the velocities where a joint has turned round, and its friction with it.

        It stops on the way. If friction holds it, it is at rest; otherwise it has gone on from
        rest for the remaining share of the substep, and so have the other coordinates under what
        has changed.

        Args:
            joint: The joint.
            turned: Where it has turned round, ``(R,)``.
            v: Velocities before the substep.
            next_q: Positions after it.
            next_v: Velocities after it, friction as it was before.
            last: Accelerations after it, friction as it was before.
            time: Seconds since the recording began.
        """
        change = np.where(turned, v[joint] - next_v[joint], 1.0)
        remaining = np.where(turned, -next_v[joint] / change, 0.0) * self.substep
        stopped = next_v.copy()
        stopped[joint] = np.where(turned, 0.0, next_v[joint])
        directions, held = self._friction_modes(next_q, stopped, time)
        after = self._rates(next_q, stopped, time, directions, held)
        result = next_v + np.where(turned, (after - last) * remaining, 0.0)
        result[joint] = np.where(turned, after[joint] * remaining, next_v[joint])
        return result

    def _rates(
        self,
        q: Array,
        v: Array,
        time: float,
        directions: Sequence[Array],
        held: Sequence[Flags | None],
    ) -> Array:
        """Returns the accelerations of all coordinates."""
        forces, motor = self._smooth_forces(q, v, time)
        for i, law, values in self._dry:
            bound = law(values, directions[i], q[i], v[i], self._drives[i])
            forces[i] = forces[i] - directions[i] * bound
        result = accelerations(self._inertia(q), forces, held)
        return np.array(result if motor is None else [*result, motor])

    def _smooth_forces(self, q: Array, v: Array, time: float) -> tuple[list[Array], Array | None]:
        """Returns all forces but dry friction, and the acceleration of a motor behind a gear."""
        forces = self._mechanics.forces(q, v)
        motor = None
        for i, drive in enumerate(self._drives):
            if i == self._geared and self._transmission is not None:
                passed = self._transmission.force(q[-1] - q[i], v[-1] - v[i])
                motor = (drive - passed) / self._transmission.motor_inertia
                drive = passed
            forces[i] = forces[i] + drive
        for i, law, values in self._forces:
            forces[i] = forces[i] + law(values, q[i], v[i], time)
        for i, bristles in self._bristles:
            forces[i] = forces[i] + bristles.force(v[i])
        for i, bursts in self._bursts:
            forces[i] = forces[i] + bursts.force(time)
        return forces, motor

    def _inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns the inertia on the links' side of the gears."""
        inertia = self._mechanics.inertia(q)
        if self._transmission is None:
            return inertia
        changed = list(inertia)
        changed[self._geared] = changed[self._geared] - self._transmission.motor_inertia
        return tuple(changed)

    def _friction_modes(
        self, q: Array, v: Array, time: float
    ) -> tuple[list[Array], list[Flags | None]]:
        """Returns the direction of each joint's motion, or break-away, and where it is held."""
        num_joints = self._mechanics.num_joints
        directions, held = [np.sign(v[i]) for i in range(num_joints)], [None] * num_joints
        if not any((v[i] == 0.0).any() for i in self._dry_joints):
            return directions, held
        forces, _ = self._smooth_forces(q, v, time)
        inertia = self._inertia(q)
        still = [(v[i] == 0.0) & (i in self._dry_joints) for i in range(num_joints)]
        # How each joint would accelerate if the other were held.
        alone = []
        for i in range(num_joints):
            direction = np.where(still[i], np.sign(forces[i]), directions[i])
            bound = self._bound(i, direction, q, v)
            slipping = forces[i] - direction * bound
            slipping = np.where(still[i] & (np.abs(forces[i]) <= bound), 0.0, slipping)
            alone.append(slipping / inertia[i])
        flags: list[Flags | None] = []
        for i in range(num_joints):
            if i not in self._dry_joints:
                flags.append(None)
                continue
            needed = forces[i]
            if num_joints == 2:
                needed = needed - inertia[2] * alone[1 - i]
            directions[i] = np.where(still[i], np.sign(needed), directions[i])
            bound = self._bound(i, directions[i], q, v)
            flags.append(still[i] & (np.abs(needed) <= bound))
        return directions, flags

    def _bound(self, joint: int, direction: Array, q: Array, v: Array) -> Array:
        """Returns the greatest dry friction of a joint."""
        total = np.zeros_like(direction)
        for i, law, values in self._dry:
            if i == joint:
                total = total + law(values, direction, q[i], v[i], self._drives[i])
        return total


def _surroundings(hidden: Sequence[Hidden]) -> Surroundings:
    """Returns the surroundings with hidden tilt and payload."""
    by_id = {h.effect_id: h.parameters for h in hidden}
    tilt = by_id.get("tilt", {})
    payload = by_id.get("payload", {})
    return Surroundings(tilt.get("roll", 0.0), tilt.get("pitch", 0.0), payload.get("mass", 0.0))
